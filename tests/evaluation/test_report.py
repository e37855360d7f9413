import math
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from rlftsim.evaluation.compare import PairedDifference
from rlftsim.evaluation.report import (
    ChartGroup,
    PairedComparison,
    Report,
    ResultRow,
    report_html,
    write_report,
)
from rlftsim.statistics import MeanInterval, interval_around
from rlftsim.viewer.chart import Chart, Curve
from rlftsim.viewer.page import Animation, Panel
from rlftsim.viewer.scene import AgentBoxes, MapLine, SceneMotion, SceneView

SVG_NAMESPACE = "http://www.w3.org/2000/svg"
VOID = {"meta", "input", "br"}


class Nesting(HTMLParser):
    """Checks that every element is closed in order (SVG shapes that close themselves excepted)."""

    def __init__(self):
        super().__init__()
        self.open, self.seen = [], []

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.seen.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def measured(mean: float, error: float = math.nan) -> MeanInterval:
    return interval_around(mean, error, 1000 if math.isfinite(error) else 1)


def parse(html: str) -> list[str]:
    """Names of all elements, in order."""
    parser = Nesting()
    parser.feed(html)
    assert parser.open == []
    return parser.seen


def draw_animation() -> Animation:
    """One car that drives along x, logged and simulated."""
    boxes = AgentBoxes(*(np.array([v]) for v in (7, 1, 4.5, 2.0, True, True)))
    scene = SceneView("drawn", (MapLine("lane", np.array([[-50.0, 0], [50, 0]])),), (), boxes, (0.0, 0.0, 40.0))
    position = np.stack([np.arange(91) - 10.0, np.zeros(91)], -1)[None, None]
    motion = SceneMotion(position, np.zeros((1, 1, 91)), np.ones((1, 1, 91), bool))
    return Animation("A drive", scene, [Panel("Logged", motion), Panel("Base", motion), Panel("Fine-tuned", motion)])


def gained(difference: float, interval: tuple[float, float], p_value: float, count: int) -> PairedDifference:
    """Difference in RMM, without a standard error where there is no interval."""
    error = 0.01 if math.isfinite(p_value) else math.nan
    return PairedDifference("meta_metric", count, 0.7, 0.7 + difference, difference, error, interval, p_value, 0.05)


@pytest.fixture
def report() -> Report:
    loss = Curve("training", range(100), np.exp(-np.arange(100) / 30))
    return Report(
        title="Fine-tuning <demo>",
        summary=["Fine-tuned beats base & all."],
        rows=[
            ResultRow("base", {"meta_metric": measured(0.7, 0.01), "collision_rate": measured(0.051, 0.002)}),
            ResultRow(
                "fine-tuned", {"meta_metric": measured(0.72, 0.01), "collision_rate": measured(0.04)}, emphasized=True
            ),
            ResultRow("oracle", {"meta_metric": measured(0.9, 0.01)}, note="the log"),
        ],
        comparisons=[PairedComparison("base", "fine-tuned", gained(0.02, (0.01, 0.03), 0.0004, 3), [0.01, 0.02, 0.03])],
        chart_groups=[ChartGroup("Pre-training", [Chart("Loss", "update", "nats", [loss])])],
        animations=[draw_animation(), draw_animation()],
        facts={"command": "rlftsim demo <quick>"},
        footnotes=["Synthetic numbers say nothing about WOMD."],
    )


def test_whole_report_is_well_formed_and_complete(report, tmp_path):
    write_report(tmp_path / "runs" / "report.html", report)
    html = (tmp_path / "runs" / "report.html").read_text()
    tags = parse(html)
    assert tags.count("table") == 1
    assert tags.count("canvas") == 6
    for heading in ("Results", "Scenarios in motion", "Pre-training", "How this was made", "Notes"):
        assert f"<h2>{heading}</h2>" in html
    assert [p.name for p in (tmp_path / "runs").iterdir()] == ["report.html"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_serious_violation(report, browser, barriers, scheme):
    page = browser.new_page(viewport={"width": 360, "height": 740}, color_scheme=scheme)
    page.set_content(report_html(report))
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    assert barriers(page) == []
    page.close()


@pytest.mark.parametrize(("scheme", "filters"), [("light", "none"), ("dark", "invert(0.9) hue-rotate(180deg)")])
def test_a_picture_of_a_run_follows_the_page(browser, tmp_path, scheme, filters):
    (tmp_path / "picture.png").write_bytes(b"")
    page, loss = browser.new_page(color_scheme=scheme), Curve("loss", [0, 1], [2.0, 1.0])
    charts = ChartGroup("Run", [Chart("Loss", "update", "nats", [loss])], "", tmp_path / "picture.png")
    page.set_content(report_html(Report("Runs", chart_groups=[charts])))
    assert page.evaluate("getComputedStyle(document.querySelector('img')).filter") == filters
    page.close()


def test_report_loads_nothing_from_elsewhere(report):
    html = report_html(report).replace(SVG_NAMESPACE, "")
    assert not re.search(r"<link|<img|<iframe|@import|\b(src|href)\s*=|url\(|https?://", html)


def test_texts_are_escaped(report):
    html = report_html(report)
    assert "Fine-tuning &lt;demo&gt;" in html
    assert "beats base &amp; all" in html
    assert "rlftsim demo &lt;quick&gt;" in html
    assert "<demo>" not in html


def test_report_with_nothing_but_a_title_is_a_page():
    tags = parse(report_html(Report("Empty")))
    assert "h1" in tags
    assert not {"h2", "table", "canvas"} & set(tags)


@pytest.mark.parametrize(
    "missing",
    [{"rows": ()}, {"comparisons": ()}, {"chart_groups": ()}, {"animations": ()}, {"facts": {}}, {"footnotes": ()}],
    ids=lambda missing: next(iter(missing)),
)
def test_each_part_may_be_missing(report, missing):
    parse(report_html(Report(**{**vars(report), **missing})))


def test_table_shows_mean_standard_error_and_interval(report):
    html = report_html(report)
    # 0.7 ± 1.962 x 0.01 (t, 999 degrees of freedom); a rate of 0.051 is 5.1 %
    assert '<td title="95 % interval 0.6804 to 0.7196">0.7000 <span class="error">± 0.0100</span></td>' in html
    assert '5.10 <span class="error">± 0.20</span>' in html
    assert "<td>4.00</td>" in html  # no standard error, no interval
    assert "kinematic" not in re.search(r"<thead>.*</thead>", html)[0]  # no row has it


def test_missing_and_undefined_numbers_are_dashes():
    rows = [ResultRow(name, {"meta_metric": measured(mean)}) for name, mean in (("a", math.nan), ("b", 0.5))]
    html = report_html(Report("t", rows=rows))
    assert html.count("<td>–</td>") == 1
    assert "nan" not in re.search(r"<table.*</table>", html)[0]


@pytest.mark.parametrize(
    ("interval", "words"),
    [((0.01, 0.03), "scores higher"), ((-0.03, -0.01), "scores lower"), ((-0.01, 0.03), "No difference")],
)
def test_verdict_follows_the_interval(interval, words):
    comparison = PairedComparison("base", "fine-tuned", gained(0.01, interval, 0.04, 20))
    assert words in comparison.verdict_text
    assert words in report_html(Report("t", comparisons=[comparison]))


def test_a_difference_that_cannot_be_tested_says_why():
    comparison = PairedComparison("a", "b", gained(0.01, (math.nan, math.nan), math.nan, 1))
    assert comparison.verdict_text == "RMM: no verdict: a single scenario, which differs by +0.0100."
    assert "paired t-test" not in report_html(Report("t", comparisons=[comparison]))


def test_a_difference_without_an_interval_is_drawn_without_one():
    comparison = PairedComparison("a", "b", gained(0.01, (math.nan, math.nan), math.nan, 2), [0.0, 0.02])
    page = report_html(Report("t", comparisons=[comparison]))
    assert "nan" not in page
    assert page.count("<circle") == 3


def test_drift_has_a_table_of_its_own_where_it_was_measured():
    """Its numbers have units and no arrow, as the log's own are the best."""
    rows = [ResultRow("tuned", {"speed_gap": measured(-1.25), "lane_heading_curved": measured(math.radians(3.0))})]
    html = report_html(Report("demo", rows=rows))
    assert "<h2>Results</h2>" not in html
    for text in ("Drift from the log", "speed − log [m/s]</abbr>", ">−1.25<", ">3.0<"):
        assert text in html
    assert "Drift from the log" not in report_html(
        Report("demo", rows=[ResultRow("a", {"meta_metric": measured(0.5)})])
    )
