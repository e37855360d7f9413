"""Models of who enters the region around the ego, where lanes cross its border; names in `ENTRIES`.

A package of your own adds one:

[project.entry-points."rlftsim.entries"]
busy = "my_package:BUSY"

G gates, K entrants of logs.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int64

from rlftsim.errors import ConfigError, DataError
from rlftsim.geometry import wrapped
from rlftsim.jobs.arrays import read_npz
from rlftsim.plugins import ExtensionPoint
from rlftsim.rollout.gates import DECISION_STEPS, STANDING_MPS, GateFinder, Gates, find_region_m
from rlftsim.rollout.types import write_npz
from rlftsim.scenario.types import CURRENT_STEP, STEP_S, ObjectType, Scenario

SHIPPED = Path(__file__).with_name("fitted_entries.npz")
"""Model "fitted", of 120 long logs of 24 synthetic street networks:

python -c 'from rlftsim.scenario.synthetic.generate import generate; generate("FIT", num_scenarios=120,
    seed=(1 << 48) + 20261130, num_steps=711, splits={"training": 1.0}, scenarios_per_network=5)'
rlftsim entries fit FIT src/rlftsim/rollout/fitted_entries.npz
"""
REACH_M, BEYOND_M = 15.0, 30.0
"""Largest distances from the border, inside and outside, of agents that enter a log; the first is also the largest
distance from the gate of an entrant that is described.
"""
FIXED_PER_S = 0.03
"""Entries per second of a gate where traffic drives in, of `fixed-rate`: about 100 vehicles per hour and lane."""
LEAST_MPS, LEAST_CLOSING_MPS = 0.3, 1.0
LANE_HALF_WIDTH_M, MOST_TURN_RAD = 1.5, 0.4
NEWTON_STEPS = 30
RIDGE = np.diag([1e-3, 2.0, 2.0])
"""Counts of entries that weigh as much as the prior of weights 0: a few logs say little of densities."""
MOST_ENTRANTS = 2000
"""Entrants that a model keeps, evenly from all logs: more make the draw slower and no better."""


@dataclass(frozen=True, eq=False)
class Entrants:
    """Who enters, relative to the lane of a gate."""

    object_type: Int64[np.ndarray, "K"]
    left_m: Float[np.ndarray, "K"]
    """Distance from the lane's center to the left."""
    turn_rad: Float[np.ndarray, "K"]
    """Heading minus direction of the lane."""
    speed_mps: Float[np.ndarray, "K"]

    def select(self, index: Int64[np.ndarray, "n"]) -> "Entrants":
        """Some of the entrants."""
        return Entrants(*(values[index] for values in vars(self).values()))


@runtime_checkable
class EntryModel(Protocol):
    """Decides at each gate and half second whether somebody enters, and who."""

    def expect(self, gates: Gates) -> Float[np.ndarray, "G"]:
        """Expected number of entries in half a second at each gate.

        Args:
            gates: Places where lanes cross the border of the region, with the speeds at which these come nearer.
        """
        ...

    def draw(self, gates: Gates, rng: np.random.Generator) -> Entrants:
        """An entrant for each gate.

        Args:
            gates: Gates at which somebody enters.
            rng: Generator of all choices.
        """
        ...


class NoEntries:
    """Nobody enters; agents only leave."""

    def expect(self, gates: Gates) -> Float[np.ndarray, "G"]:
        """Zeros."""
        return np.zeros(len(gates))

    def draw(self, gates: Gates, rng: np.random.Generator) -> Entrants:
        """Vehicles in the middle of the lane at its speed.

        Args:
            gates: Gates at which somebody enters.
            rng: Generator of all choices, not used.
        """
        zeros = np.zeros(len(gates))
        return Entrants(np.ones(len(gates), np.int64), zeros, zeros, gates.lane_mps)


class FixedRate(NoEntries):
    """Vehicles enter at the same rate at every gate where traffic drives in."""

    def expect(self, gates: Gates) -> Float[np.ndarray, "G"]:
        """A constant where the lane leads in, else 0."""
        return FIXED_PER_S * DECISION_STEPS * STEP_S * (gates.lane_closing_mps > LEAST_MPS)


@dataclass(frozen=True, eq=False)
class FittedEntries:
    """Poisson regressions of moving and of standing entrants, on closing speed and density; entrants of logs."""

    moving: Float[np.ndarray, "3"]
    """Weights of the inputs, moving entrants."""
    standing: Float[np.ndarray, "3"]
    """Weights of the inputs, standing entrants such as parked cars."""
    entrants: Entrants
    closing_mps: Float[np.ndarray, "K"]
    """Closing speed of each entrant, m/s: a fast entrant is frequent at the gate of the log, and less so at others."""

    def expect(self, gates: Gates) -> Float[np.ndarray, "G"]:
        """Exponentials of both linear predictors."""
        return self._expect_both(gates).sum(-1)

    def _expect_both(self, gates: Gates) -> Float[np.ndarray, "G 2"]:
        inputs = zip((self.moving, self.standing), _describe(gates))
        rates = np.stack([np.exp(np.minimum(values @ weights, 0.0)) for weights, values in inputs], -1)
        stands = self.entrants.speed_mps < STANDING_MPS
        return rates * [(~stands).any(), stands.any()]  # nobody enters in the place of those that no log describes

    def draw(self, gates: Gates, rng: np.random.Generator) -> Entrants:
        """Entrants of the logs, each at a gate where it drives in, or stands and is reached by the ego.

        Args:
            gates: Gates at which somebody enters.
            rng: Generator of all choices.
        """
        # speed [G, K] at which each entrant would come nearer at each gate, over that at which it came
        direction, (x, y) = gates.heading[:, None] + self.entrants.turn_rad, gates.inward.T[..., None]
        closing = self.entrants.speed_mps * (np.cos(direction) * x + np.sin(direction) * y)
        weight = np.maximum(closing + gates.standing_closing_mps[:, None], 1e-6)
        weight /= np.maximum(self.closing_mps, LEAST_CLOSING_MPS)
        rates, stands = self._expect_both(gates), self.entrants.speed_mps < STANDING_MPS
        for number, is_chosen in enumerate((~stands, stands)):
            weight[:, is_chosen] *= rates[:, [number]] / np.maximum(weight[:, is_chosen].sum(1, keepdims=True), 1e-6)
        level = weight.cumsum(1)
        index = (level < rng.random((len(gates), 1)) * level[:, -1:]).sum(1)
        return self.entrants.select(index)


def _describe(gates: Gates) -> list[Float[np.ndarray, "G 3"]]:
    """Inputs of both regressions: 1, and logarithms of the closing speed and of the density."""
    return [
        np.stack([np.ones(len(gates)), np.log(LEAST_MPS + np.maximum(closing_mps, 0.0)), np.log(per_km)], -1)
        for closing_mps, per_km in (
            (gates.lane_closing_mps, gates.moving_per_km), (gates.standing_closing_mps, gates.standing_per_km)
        )
    ]  # fmt: skip


def fit_entries(scenarios: Sequence[Scenario]) -> FittedEntries:
    """Entry model of long logs, by Newton's method on the Poisson likelihood.

    Args:
        scenarios: Logs with lanes, longer than 9.1 s, in which agents become visible at the border of a region.

    Raises:
        DataError: Nobody enters in the logs.
    """
    inputs, counts, rows = [], [], []
    for scenario in scenarios:
        log, finder = _LoggedEntries(scenario), GateFinder(scenario)
        for step in range(CURRENT_STEP, scenario.num_steps - DECISION_STEPS, DECISION_STEPS):
            if not log.valid[log.ego, step]:
                continue
            gates = finder.find(log.position[log.ego, step], log.velocity[log.ego, step], log.region_m)
            if not len(gates):
                continue
            gate, entered = log.assign(gates, step)
            stands = log.speed(entered, step) < STANDING_MPS
            inputs.append(_describe(gates))
            counts.append(
                np.stack([np.bincount(gate[chosen], minlength=len(gates)) for chosen in (~stands, stands)], -1)
            )
            rows.append(log.describe(gates, gate, entered, step))
    if not any(len(row.speed_mps) for row, _ in rows):
        raise DataError("nobody enters in these logs: take longer ones, as rlftsim synthesize --seconds 70 makes.")
    entrants = Entrants(*(np.concatenate(values) for values in zip(*(vars(row).values() for row, _ in rows))))
    closing_mps, count = np.concatenate([closing for _, closing in rows]), len(entrants.speed_mps)
    kept = np.linspace(0, count - 1, min(count, MOST_ENTRANTS)).astype(np.int64)
    moving, standing = (np.concatenate(values) for values in zip(*inputs))
    y = np.concatenate(counts)
    return FittedEntries(
        _fit_poisson(moving, y[:, 0]), _fit_poisson(standing, y[:, 1]), entrants.select(kept), closing_mps[kept]
    )


def _fit_poisson(x: Float[np.ndarray, "n 3"], y: Int64[np.ndarray, "n"]) -> Float[np.ndarray, "3"]:
    """Weights of the inputs, of which the first is 1, by Newton's method."""
    weights = np.array([np.log(max(y.mean(), 1e-6)), 0.0, 0.0])
    for _ in range(NEWTON_STEPS):
        expected = np.exp(x @ weights)
        curvature = (x * expected[:, None]).T @ x + RIDGE
        weights = weights + np.linalg.solve(curvature, x.T @ (y - expected) - RIDGE @ weights)
    return weights


class _LoggedEntries:
    """Motion of a log's agents in its map frame."""

    def __init__(self, scenario: Scenario):
        tracks, self.ego = scenario.tracks, scenario.ego_index
        self.position = tracks.position[..., :2].astype(np.float64) - scenario.origin
        self.velocity, self.heading, self.valid = tracks.velocity, tracks.heading, tracks.valid
        self.object_type = tracks.object_type.astype(np.int64)
        self.region_m = find_region_m(scenario)
        self.distance = np.linalg.norm(self.position - self.position[self.ego], axis=-1)  # [O, S]

    def assign(self, gates: Gates, step: int) -> tuple[Int64[np.ndarray, "K"], Int64[np.ndarray, "K"]]:
        """Nearest gate and track of each agent that is seen half a second later near the border and was not seen."""
        later = step + DECISION_STEPS
        outside_m = self.distance[:, later] - self.region_m
        enters = self.valid[:, later] & ~self.valid[:, step] & (outside_m > -REACH_M) & (outside_m < BEYOND_M)
        tracks = np.flatnonzero(enters)
        gap = np.linalg.norm(self.position[tracks, None, later] - gates.position, axis=-1)
        return gap.argmin(1) if len(tracks) else np.zeros(0, np.int64), tracks

    def speed(self, tracks: Int64[np.ndarray, "K"], step: int) -> Float[np.ndarray, "K"]:
        """Speeds half a second later, m/s."""
        return np.linalg.norm(self.velocity[tracks, step + DECISION_STEPS], axis=-1).astype(float)

    def describe(self, gates: Gates, gate: np.ndarray, tracks: np.ndarray, step: int) -> tuple[Entrants, np.ndarray]:
        """Entrants relative to their gates' lanes, and the speeds at which they come nearer to the ego."""
        later = step + DECISION_STEPS
        offset = self.position[tracks, later] - gates.position[gate]
        normal = np.stack([-np.sin(gates.heading[gate]), np.cos(gates.heading[gate])], -1)
        speed = self.speed(tracks, step)
        turn = wrapped(self.heading[tracks, later] - gates.heading[gate])
        left = (offset * normal).sum(-1)
        # a vehicle that drives along another lane than the nearest gate's tells nothing of that lane
        is_along = (np.abs(left) < LANE_HALF_WIDTH_M) & (np.abs(turn) < MOST_TURN_RAD)
        is_described = is_along | (speed < STANDING_MPS) | (self.object_type[tracks] != ObjectType.VEHICLE)
        is_described &= np.linalg.norm(offset, axis=-1) < REACH_M
        closing = (self.velocity[tracks, later] * gates.inward[gate]).sum(-1) + gates.standing_closing_mps[gate]
        described = np.flatnonzero(is_described)
        entrants = Entrants(self.object_type[tracks], left, turn.astype(float), speed)
        return entrants.select(described), closing[described].astype(float)


NO_ENTRIES, FIXED_RATE = NoEntries(), FixedRate()
ENTRIES: ExtensionPoint[EntryModel] = ExtensionPoint(
    "entry model",
    "rlftsim.entries",
    {
        "none": "rlftsim.rollout.entries:NO_ENTRIES",
        "fixed-rate": "rlftsim.rollout.entries:FIXED_RATE",
        "fitted": "rlftsim.rollout.entries:FITTED",
    },
    use=lambda name: load_entries(name),
)
"""Name -> entry model."""


def load_entries(name: str | None) -> EntryModel | None:
    """The entry model of a name or of a file; None where nobody enters.

    Args:
        name: Registered name such as "fixed-rate", or a file that `rlftsim entries fit` wrote, FILE.npz.

    Raises:
        ConfigError: An unknown name, with the nearest known one, or an object that is no entry model.
        DataError: A missing or damaged file.
    """
    if name is None:
        return None
    if name.endswith(".npz"):
        return _read_entries(name)
    if Path(name).is_file():
        raise ConfigError(f"{name}: a file of entries ends in .npz: rename it.")
    model = ENTRIES.get(name)
    if isinstance(model, type) or not isinstance(model, EntryModel):
        raise ConfigError(f"entry model {name!r} is of type {type(model).__name__}: give it expect and draw.")
    return model


def identify_entries(name: str | None) -> str | None:
    """Text that is equal for the same entry model: the name, or a hash of the file; None where nobody enters."""
    if name is None:
        return None
    name = str(SHIPPED) if name == "fitted" else name
    return hashlib.sha256(Path(name).read_bytes()).hexdigest()[:16] if name.endswith(".npz") else name


def write_entries(path: Path, model: FittedEntries) -> None:
    """Write a fitted model to FILE.npz, whole or not at all.

    Args:
        path: File that `load_entries` reads.
        model: Weights of the regression, and the entrants of the logs.
    """
    weights = {"moving": model.moving, "standing": model.standing, "closing_mps": model.closing_mps}
    write_npz(path, **weights, **vars(model.entrants))


def _read_entries(path: str) -> FittedEntries:
    weights, remedy = ("moving", "standing"), "fit it again with rlftsim entries fit"
    names = (*weights, "closing_mps", *(column.name for column in fields(Entrants)))
    try:
        arrays = read_npz(path, names, remedy)
    except FileNotFoundError:
        raise DataError(f"{path}: there is no such file of entries: {remedy}.") from None
    columns = [arrays.get(name) for name in names]
    lengths = {column.shape for column in columns[2:] if column is not None}
    are_numbers = all(c is not None and c.ndim == 1 and c.dtype.kind in "if" and np.isfinite(c).all() for c in columns)
    is_right = are_numbers and len(lengths) == 1 and lengths != {(0,)}
    is_right = is_right and all(arrays[name].shape == (3,) for name in weights)
    if is_right:
        is_right = np.isin(arrays["object_type"], (1, 2, 3)).all() and (arrays["speed_mps"] >= 0).all()
    if not is_right:
        raise DataError(f"{path}: no {', '.join(names)} as finite numbers of equal length in it: {remedy}.")
    # the values of a file may be anything: rates stay below two entries per gate and half second, speeds below 180 km/h
    moving, standing, closing_mps, object_type, *rest = (c.clip(-50, 50) for c in columns if c is not None)
    entrants = Entrants(object_type.astype(np.int64), *rest)
    return FittedEntries(moving.astype(float), standing.astype(float), entrants, closing_mps)


def __getattr__(name: str) -> FittedEntries:
    """The shipped model, read when it is asked for."""
    if name != "FITTED":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _read_entries(str(SHIPPED))
