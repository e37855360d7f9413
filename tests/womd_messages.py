"""A WOMD scenario as the message of its files."""

from rlftsim.scenario import womd_pb2


def build_message(scenario_id="0a1b", *, num_steps=91, num_tracks=3, lights=True) -> womd_pb2.Scenario:
    """Three road users in a row on one straight lane; the last is the ego.

    Track k starts at (1000 + 10 k, -200) and drives (1 + k) m/s along +x: x = 1000 + 10 k + 0.1 (1 + k) step.
    """
    message = womd_pb2.Scenario(scenario_id=scenario_id, sdc_track_index=num_tracks - 1, current_time_index=10)
    message.timestamps_seconds.extend(0.1 * step for step in range(num_steps))
    for k in range(num_tracks):
        track = message.tracks.add(id=100 + k, object_type=1 + k % 3)
        for step in range(num_steps):
            track.states.add(
                center_x=1000.0 + 10.0 * k + 0.1 * (1 + k) * step,
                center_y=-200.0,
                center_z=3.25,
                length=4.5,
                width=2.0,
                height=1.5,
                heading=0.0,
                velocity_x=1.0 + k,
                velocity_y=0.0,
                valid=True,
            )
    message.tracks_to_predict.add(track_index=0, difficulty=2)
    message.objects_of_interest.extend([100, 101])
    lane = message.map_features.add(id=7).lane
    lane.type = womd_pb2.LaneCenter.TYPE_SURFACE_STREET
    lane.speed_limit_mph = 25.0
    for x in range(900, 1200, 10):
        lane.polyline.add(x=x, y=-200.0, z=3.0)
    edge = message.map_features.add(id=8).road_edge
    edge.type = womd_pb2.RoadEdge.TYPE_ROAD_EDGE_BOUNDARY
    edge.polyline.add(x=900.0, y=-204.0, z=3.0)
    edge.polyline.add(x=1200.0, y=-204.0, z=3.0)
    if lights:
        for _ in range(num_steps):
            light = message.dynamic_map_states.add().lane_states.add(lane=7, state=6)
            light.stop_point.x, light.stop_point.y, light.stop_point.z = 1100.0, -200.0, 3.0
    return message
