"""Tables of the paper (RLFTSim, CVPR 2026), to be shown beside ours; captions shortened."""

from rlftsim.experiments.tables import TextTable

NOTE = (
    "The paper's numbers, not comparable with ours: WOMD, a 7 M model pre-trained for 32 epochs, fine-tuned on 487 000 "
    "scenarios."
)
SCORES = ("", "RMM ↑", "kinematic ↑", "interactive ↑", "map-based ↑")


def _table(title: str, headings: tuple[str, ...], lines: str, note: str = "") -> TextTable:
    rows = tuple(tuple(cell.strip() for cell in line.split("|")) for line in lines.strip().splitlines())
    return TextTable(f"The paper: {title}", headings, rows, f"{NOTE} {note}".strip())


BENCHMARK = _table(
    "benchmark (Tab. 1; the oracle from the appendix)",
    SCORES,
    """
    SMART-tiny, their reference model | 0.7824 | 0.4854 | 0.8089 | 0.9180
    SMART-tiny CAT-K | 0.7856 | 0.4931 | 0.8106 | 0.9205
    RLFTSim | 0.7867 | 0.4927 | 0.8129 | 0.9210
    oracle (20 % of validation) | 0.8293 | 0.5498 | 0.8523 | 0.9594
    """,
    "Private test split, traffic light likelihood 1.",
)
AGNOSTICISM = _table(
    "another architecture, TrafficBots V1.5",
    SCORES,
    """
    TrafficBots V1.5, their reference model | 0.7174 | 0.4271 | 0.7317 | 0.8650
    RLFTSim | 0.7231 | 0.4321 | 0.7377 | 0.8704
    """,
    "20 % of validation; this model has continuous actions and was pre-trained for one epoch.",
)
REWARDS = _table(
    "rewards (Tab. 2)",
    (*SCORES, "minADE [m] ↓"),
    """
    SMART-tiny, their reference model | 0.7804 ± 0.0003 | 0.4904 ± 0.0005 | 0.8032 ± 0.0004 | 0.9167 ± 0.0006 | 1.30
    minADE, RLOO | 0.7801 ± 0.0003 | 0.4897 ± 0.0005 | 0.8032 ± 0.0004 | 0.9161 ± 0.0006 | 1.32
    RMM, RLOO | 0.7821 ± 0.0003 | 0.4913 ± 0.0005 | 0.8065 ± 0.0004 | 0.9169 ± 0.0006 | 1.32
    RMM, MLOO | 0.7830 ± 0.0003 | 0.4924 ± 0.0005 | 0.8070 ± 0.0004 | 0.9182 ± 0.0006 | 1.32
    collision + off-road + ADE | 0.7803 ± 0.0003 | 0.4896 ± 0.0005 | 0.8039 ± 0.0004 | 0.9162 ± 0.0006 | 1.33
    collision + off-road | 0.7786 ± 0.0004 | 0.4891 ± 0.0005 | 0.8037 ± 0.0004 | 0.9117 ± 0.0006 | 1.35
    """,
    "Full validation split.",
)
HEURISTICS = _table(
    "heuristic rewards (appendix)",
    ("", "RMM ↑", "collision [%] ↓", "off-road [%] ↓", "ADE [m] ↓", "minADE [m] ↓"),
    """
    SMART-tiny, their reference model | 0.7769 | 5.67 | 15.14 | 2.59 | 1.30
    RMM, MLOO | 0.7818 | 4.53 | 14.71 | 2.55 | 1.31
    collision + off-road + ADE | 0.7788 | 4.93 | 14.73 | 2.39 | 1.32
    collision + off-road | 0.7769 | 4.51 | 13.95 | 2.62 | 1.36
    """,
    "20 % of validation.",
)
T_TEST = _table(
    "paired t-test (appendix)",
    ("", "MLOO", "RLOO", "c. + o. + ADE", "reference", "minADE", "c. + o."),
    """
    RMM, MLOO | | + | + | + | + | +
    RMM, RLOO | − | | + | + | + | +
    collision + off-road + ADE | − | − | | ~ | + | +
    reference model | − | − | ~ | | + | +
    minADE, RLOO | − | − | − | − | | +
    collision + off-road | − | − | − | − | − |
    """,
    "44 097 scenarios, level 0.001.",
)
CURVE = _table(
    "RMM against epochs of fine-tuning (appendix)",
    ("epochs", "RLFTSim", "CAT-K", "RLFTSim, weak base (1 epoch)"),
    """
    0 | 0.7769 | 0.7769 | 0.7507
    0.25 | 0.7814 | 0.7809 | –
    0.5 | 0.7818 | 0.7810 | 0.7637
    1 | 0.7817 | 0.7809 | 0.7636
    1.5 | 0.7811 | – | 0.7642
    2 | – | 0.7809 | –
    5 | – | 0.7798 | –
    """,
    "20 % of validation.",
)
ORACLE = _table(
    "oracle (appendix)", SCORES, "ground truth as rollouts | 0.8293 | 0.5498 | 0.8523 | 0.9594", "20 % of validation."
)
GOALS = _table(
    "goal conditioning (Tab. 3)",
    ("", "passing miss [%] ↓", "kinematic ↑", "interactive ↑", "map-based ↑", "RMM ↑"),
    """
    goal-free (RLFTSim) | 16.631 ± 0.098 | 0.4924 ± 0.0005 | 0.8070 ± 0.0004 | 0.9182 ± 0.0006 | 0.7830 ± 0.0003
    concatenation, soft | 10.473 ± 0.065 | 0.4794 ± 0.0005 | 0.8045 ± 0.0004 | 0.9134 ± 0.0006 | 0.7776 ± 0.0003
    concatenation, hard | 14.978 ± 0.091 | 0.4791 ± 0.0005 | 0.8045 ± 0.0004 | 0.9129 ± 0.0006 | 0.7774 ± 0.0003
    indication, soft | 9.180 ± 0.059 | 0.4887 ± 0.0005 | 0.8068 ± 0.0004 | 0.9175 ± 0.0006 | 0.7819 ± 0.0003
    indication, hard | 13.393 ± 0.082 | 0.4916 ± 0.0005 | 0.8068 ± 0.0004 | 0.9179 ± 0.0006 | 0.7827 ± 0.0003
    """,
    "Full validation split; goals are the logged endpoints.",
)
MANEUVERS = _table(
    "alternative maneuvers only (appendix)",
    ("", "reached [%] ↑", "passed [%] ↑"),
    """
    SMART-tiny, their reference model | 35.37 | 42.89
    concatenation, soft | 37.59 | 75.34
    concatenation, hard | 50.00 | 68.37
    indication, soft | 38.78 | 64.46
    indication, hard | 44.22 | 50.68
    """,
    "Ego of 100 scenarios, goals picked by hand, 20 000 updates. Other conditions, and the kinematic benchmark, are "
    "given as curves only.",
)
