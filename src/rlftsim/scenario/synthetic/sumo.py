"""SUMO as a subprocess: compile a street plan, route demand, simulate. SUMO is not imported."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from xml.sax.saxutils import quoteattr

from rlftsim.errors import ConfigError, RlftsimError
from rlftsim.scenario.synthetic.street_plan import StreetPlan

INSTALL_HINT = 'Making synthetic scenarios needs SUMO and shapely: pip install "rlftsim[synthetic]".'
SIMULATED_S = 300
DISCARDED_S = 60

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
    suffix = ".exe" if sys.platform == "win32" else ""
    path = Path(next(iter(package.submodule_search_locations))) / "bin" / f"{name}{suffix}"
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
        "sumo", "-n", network, "-r", routes, "-a", additional, "--seed", seed,
        "--step-length", 0.1, "--default.action-step-length", 0.1, "--step-method.ballistic",
        "--begin", 0, "--end", SIMULATED_S, "--time-to-teleport", -1, "--collision.action", "warn",
        "--lanechange.duration", 3, "--fcd-output", folder / "vehicles.csv",
        "--person-fcd-output", folder / "persons.csv", "--device.fcd.begin", DISCARDED_S,
        "--fcd-output.attributes", "x,y,angle,type,speed,pos,lane", "--precision", 4,
        "--no-step-log", "--no-warnings", "--xml-validation", "never", "--ignore-route-errors",
    )  # fmt: skip
    return folder / "vehicles.csv", folder / "persons.csv"
