"""Tables of the paper, to be shown beside ours, from `published.md`."""

from importlib import resources

from rlftsim.experiments.tables import TextTable


def load_table(name: str) -> TextTable:
    """Table of the paper by the heading of a section of `published.md`."""
    text = (resources.files("rlftsim.experiments.paper") / "published.md").read_text(encoding="utf-8")
    (_, general_note), *sections = (section.split("\n\n") for section in text.strip().split("\n\n## "))
    title, table, *notes = next(paragraphs for heading, *paragraphs in sections if heading == name)
    headings, _, *rows = (tuple(cell.strip() for cell in line.split("|")[1:-1]) for line in table.split("\n"))
    return TextTable(f"The paper: {title}", headings, tuple(rows), " ".join((general_note, *notes)))
