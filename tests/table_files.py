"""Tables of recordings, as `docs/extending.md` describes them."""

import pyarrow as pa
import pyarrow.parquet as pq


def car(object_id, x, y=0.0, *, speed=10.0, kind="vehicle", steps=range(91), step_s=0.1, scenario_id="one", **more):
    """Rows of an object that drives along +x, at x at step 0."""
    return [
        {
            "scenario_id": scenario_id, "object_id": object_id, "type": kind, "step": step,
            "x": x + speed * step * step_s, "y": y, "heading": 0.0, "vx": speed, "vy": 0.0, **more,
        }
        for step in steps
    ]  # fmt: skip


def line(feature_id, kind, *points, scenario_id="one", **more):
    return [
        {"scenario_id": scenario_id, "feature_id": feature_id, "type": kind, "x": x, "y": y, **more} for x, y in points
    ]


MAP = [
    *line(1, "lane_surface_street", (-50, 0), (200, 0)),
    *line(2, "edge_boundary", (-50, -2), (200, -2)),
    *line(3, "edge_boundary", (200, 6), (-50, 6)),
    *line(4, "lane_surface_street", (200, 4), (-50, 4)),
]


def write_tables(folder, tracks=None, scenarios=None, map_rows=None, **others):
    """Tables of one scenario with two cars."""
    folder.mkdir(parents=True, exist_ok=True)
    tables = {
        "tracks": [*car(7, 0.0), *car(8, 20.0, speed=8.0)] if tracks is None else tracks,
        "scenarios": [{"scenario_id": "one", "ego_id": 7, "predict": [8]}] if scenarios is None else scenarios,
        "map": MAP if map_rows is None else map_rows,
        **others,
    }
    for name, rows in tables.items():
        pq.write_table(rows if isinstance(rows, pa.Table) else pa.Table.from_pylist(rows), folder / f"{name}.parquet")
    return folder
