"""SUMO as a subprocess: compile a street plan, draw and route demand, simulate. SUMO is not imported."""

import importlib.util
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from rlftsim.errors import ConfigError, RlftsimError
from rlftsim.scenario.synthetic.street_plan import StreetPlan, find_reachable
from rlftsim.scenario.types import ObjectType

INSTALL_HINT = 'Making synthetic scenarios needs SUMO and shapely: pip install "rlftsim[synthetic]".'
SIMULATED_S = 300
DISCARDED_S = 60
OPTIONS = (
    "--step-length", "0.1", "--default.action-step-length", "0.1", "--step-method.ballistic",
    "--begin", "0", "--end", f"{SIMULATED_S}", "--time-to-teleport", "-1", "--collision.action", "warn",
    "--lanechange.duration", "3", "--precision", "4", "--no-step-log", "--no-warnings", "--xml-validation", "never",
    "--ignore-route-errors",
)  # fmt: skip
"""Options of the simulation, which decide the traffic together with network, routes and seed."""

_VEHICLES = "passenger bus truck delivery motorcycle bicycle"
_ALLOWED = {"sidewalk": "pedestrian", "bicycle": "bicycle", "travel": _VEHICLES}


def is_available() -> bool:
    """True if both SUMO and shapely are installed."""
    return all(importlib.util.find_spec(name) is not None for name in ("sumo", "shapely"))


def find_binary(name: str) -> Path:
    """Path of `netconvert`, `duarouter` or `sumo` inside the installed `sumo` package; PATH is ignored.

    Raises:
        ConfigError: The extra `synthetic` is not installed.
    """
    # find_spec does not import the package: SUMO does not run in this process
    package = importlib.util.find_spec("sumo")
    if package is None or not package.submodule_search_locations:
        raise ConfigError(INSTALL_HINT)
    path = Path(next(iter(package.submodule_search_locations))) / "bin" / name
    if not path.exists():
        raise ConfigError(f"{path} is missing: reinstall eclipse-sumo. {INSTALL_HINT}")
    return path


def sumo_version() -> str:
    """Version such as "1.28.0"; other versions make other traffic."""
    output = subprocess.run([find_binary("sumo"), "--version"], capture_output=True, text=True, check=True).stdout
    version = re.search(r"(\d+\.\d+\.\d+)", output)
    return version.group(1) if version else "unknown"


def _run(name: str, *options: object) -> None:
    """Run a program of SUMO; the last line of standard error is the reason of a failure."""
    # no standard input: a program that asks a question fails at once instead of waiting
    command = [str(find_binary(name)), *(str(option) for option in options)]
    done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    if done.returncode != 0:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise RlftsimError(f"{name} failed with code {done.returncode}: {reason}")


def _edges_xml(plan: StreetPlan) -> str:
    """Streets of a plan in SUMO's plain XML, with the vehicle classes that may use each lane."""
    rows = ["<edges>"]
    for street in plan.streets:
        shape = " ".join(f"{x:.3f},{y:.3f}" for x, y in street.points)
        rows.append(
            f'  <edge id={quoteattr(street.street_id)} from="{street.from_node}" to="{street.to_node}" '
            f'numLanes="{len(street.lanes)}" speed="{street.speed_mps:.2f}" priority="{street.priority}" '
            f'spreadType="right" shape="{shape}">'
        )
        for index, lane in enumerate(street.lanes):
            allowed = _ALLOWED.get(lane.lane_type)
            if lane.lane_type == "travel" and street.street_class == "residential":
                allowed = _VEHICLES.replace("bus truck ", "")  # long vehicles would cut the corners of narrow streets
            if lane.lane_type == "travel" and street.street_class in ("freeway", "ramp"):
                allowed = _VEHICLES.replace(" bicycle", "")
            permission = f'allow="{allowed}"' if allowed else 'disallow="all"'
            rows.append(f'    <lane index="{index}" width="{lane.width_m:.2f}" {permission}/>')
        rows.append("  </edge>")
    return "\n".join([*rows, "</edges>"])


def compile_network(plan: StreetPlan, folder: Path, signal_layout: str = "opposites") -> Path:
    """Write the plan as plain XML into `folder` and compile the network.

    Args:
        plan: Street plan with nodes, streets and connections.
        folder: Existing working folder; files of the same names are replaced.
        signal_layout: Approaches that share a green: `opposites` or `incoming`.

    Returns:
        Path of the network file.
    """
    nodes = [
        f'  <node id="{node.node_id}" x="{node.position[0]:.3f}" y="{node.position[1]:.3f}" type="{node.control}"'
        + (' radius="7"/>' if plan.network_type != "freeway" else "/>")
        for node in plan.nodes
    ]
    (folder / "plan.nod.xml").write_text("\n".join(["<nodes>", *nodes, "</nodes>"]))
    (folder / "plan.edg.xml").write_text(_edges_xml(plan))
    options: list[object] = ["--node-files", folder / "plan.nod.xml", "--edge-files", folder / "plan.edg.xml"]
    if plan.connections:
        links = [
            f'  <connection from="{link.from_street}" to="{link.to_street}" '
            f'fromLane="{link.from_lane}" toLane="{link.to_lane}"/>'
            for link in plan.connections
        ]
        (folder / "plan.con.xml").write_text("\n".join(["<connections>", *links, "</connections>"]))
        options += ["--connection-files", folder / "plan.con.xml"]
    # pedestrians cross wherever cars drive slowly enough
    if plan.network_type != "freeway":
        options += ["--crossings.guess", "--crossings.guess.speed-threshold", 22, "--walkingareas"]
    network = folder / "network.net.xml"
    _run(
        "netconvert", *options, "-o", network,
        "--offset.disable-normalization", "--no-turnarounds.except-deadend", "--rectangular-lane-cut",
        "--junctions.internal-link-detail", 25, "--junctions.limit-turn-speed", 4.5,
        "--tls.default-type", "actuated", "--tls.cycle.time", 70, "--tls.left-green.time", 7,
        "--tls.yellow.time", 3, "--tls.allred.time", 1, "--tls.layout", signal_layout,
        "--xml-validation", "never", "--precision", 4, "--no-warnings",
    )  # fmt: skip
    return network


def route_demand(network: Path, demand: Path, seed: int) -> Path:
    """Give every trip a route and drop the impossible ones, which would block a lane forever.

    Args:
        network: Network file of `compile_network`.
        demand: File with types, trips and walks; the routes are written to the same folder.
        seed: Seed of SUMO's random choices.

    Returns:
        Path of the routes.
    """
    routes = demand.with_name("demand.rou.xml")
    _run(
        "duarouter", "-n", network, "-r", demand, "-o", routes, "--seed", seed,
        "--ignore-errors", "--no-warnings", "--xml-validation", "never", "--named-routes", "false",
    )  # fmt: skip
    return routes


def simulate(network: Path, routes: Path, additional: Path, seed: int) -> tuple[Path, Path]:
    """Simulate `SIMULATED_S` seconds at 10 Hz; the first `DISCARDED_S` are not written.

    Args:
        network: Network file of `compile_network`; SUMO writes into the same folder.
        routes: File of `route_demand` with a route for each trip.
        additional: File with further instructions for SUMO, such as the signals to record.
        seed: Seed of SUMO's random choices.

    Returns:
        CSV files of the vehicles and of the pedestrians (the latter may not exist).
    """
    folder = network.parent
    _run(
        "sumo", "-n", network, "-r", routes, "-a", additional, "--seed", seed, *OPTIONS,
        "--fcd-output", folder / "vehicles.csv", "--person-fcd-output", folder / "persons.csv",
        "--device.fcd.begin", DISCARDED_S, "--fcd-output.attributes", "x,y,angle,type,speed,pos,lane",
    )  # fmt: skip
    return folder / "vehicles.csv", folder / "persons.csv"


# --- demand: vehicle types with drivers, trips of vehicles and bicycles, walks of pedestrians ------------------------


@dataclass(frozen=True)
class RoadUserType:
    """A type of vehicle together with the driver."""

    type_id: str
    vehicle_class: str
    object_type: ObjectType
    length_m: float
    width_m: float
    height_m: float


_PROBABILITIES = {"car": 0.62, "suv": 0.24, "van": 0.05, "truck": 0.04, "bus": 0.02, "motorcycle": 0.03}
_CLASSES = {"car": "passenger", "suv": "passenger", "van": "delivery", "truck": "truck", "bus": "bus"}
_SIZES = {
    # length, width, height: mean, spread, low, high in meters, mirrors included
    "car": ((4.55, 0.22, 4.0, 5.1), (2.04, 0.06, 1.9, 2.2), (1.56, 0.08, 1.4, 1.8)),
    "suv": ((4.85, 0.30, 4.3, 5.7), (2.18, 0.09, 2.0, 2.4), (1.85, 0.12, 1.6, 2.2)),
    "van": ((5.70, 0.40, 5.0, 6.8), (2.36, 0.10, 2.2, 2.6), (2.50, 0.20, 2.1, 2.9)),
    "truck": ((8.00, 1.40, 6.0, 11.0), (2.70, 0.12, 2.5, 2.9), (3.20, 0.30, 2.6, 3.9)),
    "bus": ((11.9, 0.40, 11.0, 12.6), (2.90, 0.08, 2.7, 3.0), (3.20, 0.10, 3.0, 3.5)),
    "motorcycle": ((2.15, 0.10, 1.9, 2.4), (0.90, 0.06, 0.8, 1.0), (1.55, 0.08, 1.4, 1.8)),
    "bicycle": ((1.85, 0.11, 1.6, 2.1), (0.84, 0.05, 0.74, 0.95), (1.80, 0.10, 1.5, 2.0)),
    "pedestrian": ((0.92, 0.10, 0.7, 1.2), (0.86, 0.08, 0.7, 1.1), (1.72, 0.13, 1.3, 2.0)),
}


NUM_GAITS = 8
"""Number of types of pedestrians, which differ in speed."""
VEHICLES_PER_LANE_AND_S = {"city": (0.02, 0.04), "quiet": (0.04, 0.075), "freeway": (0.25, 0.4)}
"""Range of the vehicles that enter per second and lane; much more is gridlock within minutes."""


def draw_size(rng: np.random.Generator, name: str) -> tuple[float, float, float]:
    """Length, width and height in meters of one road user.

    Args:
        rng: Generator of the sizes, one draw for each.
        name: Name of the road user in `_SIZES`, such as "car" or "pedestrian".
    """
    length, width, height = (float(np.clip(rng.normal(mean, std), low, high)) for mean, std, low, high in _SIZES[name])
    return length, width, height


def draw_types(rng: np.random.Generator, count: int = 36) -> list[RoadUserType]:
    """Types of one network: the last four are bicycles, the first ones motor vehicles by frequency.

    Args:
        rng: Generator of names and sizes; equal states give equal types.
        count: Number of types, above 4; more types make traffic more diverse.
    """
    names = list(rng.choice(list(_PROBABILITIES), count - 4, p=list(_PROBABILITIES.values()))) + ["bicycle"] * 4
    names[0] = "car"  # at least one: an ego has to be found
    types = []
    for index, name in enumerate(names):
        length, width, height = draw_size(rng, name)
        vehicle_class = _CLASSES.get(name, str(name))
        object_type = ObjectType.CYCLIST if name == "bicycle" else ObjectType.VEHICLE
        types.append(RoadUserType(f"{name}{index}", vehicle_class, object_type, length, width, height))
    return types


def _type_xml(rng: np.random.Generator, user_type: RoadUserType) -> str:
    """Vehicle type of SUMO with the habits of the driver. The order of the draws decides all later draws."""
    attributes = (
        f'<vType id="{user_type.type_id}" vClass="{user_type.vehicle_class}" '
        f'length="{user_type.length_m:.2f}" width="{user_type.width_m:.2f}" '
        f'lcStrategic="{rng.uniform(0.6, 1.5):.2f}" lcSpeedGain="{rng.uniform(0.4, 1.8):.2f}" '
        f'lcKeepRight="{rng.uniform(0.0, 0.4):.2f}" lcMaxSpeedLatStanding="0" lcMaxSpeedLatFactor="0.25" '
        f'jmTimegapMinor="{rng.uniform(0.6, 1.4):.2f}" impatience="{rng.uniform(0.0, 0.3):.2f}" '
    )
    if user_type.object_type == ObjectType.CYCLIST:
        return attributes + f'accel="1.0" decel="2.5" minGap="0.8" maxSpeed="{rng.uniform(3.8, 6.5):.2f}"/>'
    mean = np.clip(rng.normal(1.0, 0.06), 0.88, 1.12)
    return attributes + (
        f'carFollowModel="EIDM" accel="{rng.uniform(1.5, 2.8):.2f}" decel="{rng.uniform(1.8, 3.2):.2f}" '
        f'tau="{rng.uniform(0.8, 2.0):.2f}" minGap="{rng.uniform(1.2, 3.2):.2f}" '
        f'speedFactor="normc({mean:.3f},0.08,0.6,1.5)"/>'
    )


def _poisson_times(rng: np.random.Generator, rate_per_s: float) -> np.ndarray:
    """Departure times of a Poisson process over the simulated time, in order."""
    count = rng.poisson(rate_per_s * SIMULATED_S)
    return np.sort(rng.uniform(0, SIMULATED_S, count))


def _vehicle_trips(rng: np.random.Generator, plan: StreetPlan, types: list[RoadUserType]) -> list[tuple[float, str]]:
    """Trips from fringe to fringe, more on wide and important streets."""
    fringe = {node.node_id for node in plan.fringe_nodes}
    weight = {"arterial": 1.6, "collector": 1.0, "residential": 0.6, "freeway": 1.0, "ramp": 0.5}
    sources = [street for street in plan.streets if street.from_node in fringe]
    sinks = [street for street in plan.streets if street.to_node in fringe]
    per_lane = rng.uniform(*VEHICLES_PER_LANE_AND_S[plan.network_type])
    bicycles = 0.0 if plan.network_type == "freeway" else rng.uniform(0.01, 0.06)
    motor = [t.type_id for t in types if t.object_type == ObjectType.VEHICLE]
    cycles = [t.type_id for t in types if t.object_type == ObjectType.CYCLIST]
    links = [(street.from_node, street.to_node) for street in plan.streets]
    trips = []
    # Poisson arrivals at every entrance, by its lanes and class
    for source in sources:
        lanes = sum(lane.lane_type == "travel" for lane in source.lanes)
        # to nodes that streets lead to: the router would drop further trips
        reachable = find_reachable(source.from_node, links)
        goals = [sink for sink in sinks if sink.to_node != source.from_node and sink.to_node in reachable]
        attraction = np.array([weight[goal.street_class] * len(goal.lanes) for goal in goals])
        for time in _poisson_times(rng, per_lane * lanes * weight[source.street_class]):
            goal = goals[int(rng.choice(len(goals), p=attraction / attraction.sum()))]
            type_id = rng.choice(cycles) if rng.random() < bicycles else rng.choice(motor)
            row = (
                f'<trip id="v{len(trips)}" type="{type_id}" depart="{time:.1f}" from="{source.street_id}" '
                f'to="{goal.street_id}" departLane="best" departSpeed="max"/>'
            )
            trips.append((float(time), row))
    return trips


def _walks(rng: np.random.Generator, plan: StreetPlan) -> list[tuple[float, str]]:
    """Short walks between streets, alone or in groups; a few busy streets attract most."""
    if plan.network_type == "freeway":
        return []
    streets = [street.street_id for street in plan.streets]
    # a gamma distribution of small shape: many quiet streets, a few busy ones
    attraction = rng.gamma(0.5, 1.0, len(streets)) + 0.05
    attraction /= attraction.sum()
    walks = []
    for time in _poisson_times(rng, rng.uniform(0.04, 0.24)):
        start, goal = rng.choice(streets, 2, replace=False, p=attraction)
        size, gait = int(rng.choice([1, 2, 3], p=[0.75, 0.2, 0.05])), int(rng.integers(NUM_GAITS))
        # members of a group follow one another at 1.1 s, on the same way at the same gait
        for member in range(size):
            depart = time + 1.1 * member
            row = (
                f'<person id="p{len(walks)}" type="walker{gait}" depart="{depart:.1f}" departPos="random">'
                f'<personTrip from="{start}" to="{goal}" arrivalPos="random"/></person>'
            )
            walks.append((float(depart), row))
    return walks


def write_demand(plan: StreetPlan, rng: np.random.Generator, path: Path) -> dict[str, RoadUserType]:
    """Write types, trips and walks to a file for SUMO, ordered by departure, as SUMO requires.

    Args:
        plan: Streets to travel on, with the nodes where traffic enters.
        rng: Generator of all choices; the order of draws decides the traffic.
        path: File to write, XML of SUMO; an existing file is replaced.

    Returns:
        Type of each `type_id`.
    """
    types = draw_types(rng)
    departures = _vehicle_trips(rng, plan, types) + _walks(rng, plan)
    departures.sort(key=lambda row: row[0])
    header = [_type_xml(rng, user_type) for user_type in types]
    for gait in range(NUM_GAITS):
        factor = rng.uniform(0.55, 1.45)
        header.append(f'<vType id="walker{gait}" vClass="pedestrian" speedFactor="normc({factor:.2f},0.08,0.4,1.7)"/>')
    path.write_text("\n".join(["<routes>", *header, *(row for _, row in departures), "</routes>"]))
    return {user_type.type_id: user_type for user_type in types}
