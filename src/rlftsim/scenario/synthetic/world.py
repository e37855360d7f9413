"""One simulated street network with its traffic, from a seed."""

from pathlib import Path

import numpy as np

from rlftsim.scenario.synthetic import sumo
from rlftsim.scenario.synthetic.bodies import read_pedestrians, read_signals, read_vehicles
from rlftsim.scenario.synthetic.crop import MapCropper, draw_ground
from rlftsim.scenario.synthetic.map_features import build_network_map
from rlftsim.scenario.synthetic.network import read_network
from rlftsim.scenario.synthetic.parking import park_in_lots, park_in_strips
from rlftsim.scenario.synthetic.street_plan import draw_city_plan, draw_freeway_plan
from rlftsim.scenario.synthetic.sumo import write_demand
from rlftsim.scenario.synthetic.windows import SumoSource, World
from rlftsim.scenario.types import STEP_S

LOTS_PER_STREET = {"city": 0.35, "quiet": 0.22, "freeway": 0.0}
_NUM_STEPS = round((sumo.SIMULATED_S - sumo.DISCARDED_S) / STEP_S)


def simulate_world(network_type: str, seed: tuple[int, ...], folder: Path, keeps_source: bool = False) -> World:
    """Draw a network, let SUMO fill it with traffic, and turn the output into bodies, lights and a map.

    Args:
        network_type: Type of the network, "city", "quiet" or "freeway".
        seed: Seed of all choices; the same seed and version of SUMO give the same world.
        folder: Existing folder for SUMO's files; the caller deletes the files.
        keeps_source: True = the world holds what SUMO needs to run it again, and boxes are made from the past alone.

    Raises:
        ConfigError: SUMO is not installed.
        RlftsimError: A program of SUMO failed.
    """
    # One generator for all steps: the order of steps is part of a seed's meaning.
    rng = np.random.default_rng(seed)

    # 1. Streets.
    plan = draw_freeway_plan(rng) if network_type == "freeway" else draw_city_plan(rng, quiet=network_type == "quiet")
    layout = "opposites" if rng.random() < 0.75 else "incoming"
    network_file = sumo.compile_network(plan, folder, layout)
    network = read_network(network_file, plan)

    # 2. Traffic. An additional file makes SUMO write every junction's signal states.
    types = write_demand(plan, rng, folder / "demand.xml")
    sumo_seed = int(rng.integers(1, 2**31 - 1))
    routes = sumo.route_demand(network_file, folder / "demand.xml", sumo_seed)
    signal_files = {junction: folder / f"signals_{junction}.xml" for junction in network.lights}
    events = [f'<timedEvent type="SaveTLSStates" source="{k}" dest="{path}"/>' for k, path in signal_files.items()]
    additional = folder / "additional.xml"
    additional.write_text("\n".join(["<additional>", *events, "</additional>"]))
    vehicles_file, persons_file = sumo.simulate(network_file, routes, additional, sumo_seed)

    # 3. Map and bodies.
    network_map = build_network_map(network)
    bodies = read_vehicles(vehicles_file, network, types, rng, keeps_source)
    bodies += read_pedestrians(persons_file, rng, keeps_source)
    bodies += park_in_strips(rng, network, _NUM_STEPS)
    bodies += park_in_lots(rng, network, network_map.drivable, _NUM_STEPS, LOTS_PER_STREET[network_type])
    cropper = MapCropper(network_map, draw_ground(rng))
    signals = {junction: read_signals(path) for junction, path in signal_files.items()}
    ends = np.stack([node.position for node in plan.fringe_nodes])
    # other boxes than those of the same seed without a source, so other ids
    name = "/".join(map(str, (*seed, "source")[: len(seed) + keeps_source]))
    source = SumoSource(network_file.read_text(), routes.read_text(), sumo_seed) if keeps_source else None
    return World(name, tuple(bodies), cropper, signals, ends, _NUM_STEPS, source)
