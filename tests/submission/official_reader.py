"""Script for an environment with Waymo's own package: validates unpacked shards, and scores some of their scenarios.

python official_reader.py SHARDS SCENARIOS [--score ID ...]: one JSON object on standard output.
"""

import argparse
import json
import os
import pathlib

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("shards", type=pathlib.Path)
    parser.add_argument("scenarios", type=pathlib.Path)
    parser.add_argument("--score", nargs="*", default=())
    options = parser.parse_args()
    import tensorflow as tf
    from google.protobuf import text_format
    from waymo_open_dataset.protos import scenario_pb2, sim_agents_metrics_pb2, sim_agents_submission_pb2
    from waymo_open_dataset.utils.sim_agents import submission_specs

    logs = {}
    for path in sorted(options.scenarios.rglob("*tfrecord*")):
        for record in tf.data.TFRecordDataset(str(path)) if path.is_file() else ():
            scenario = scenario_pb2.Scenario.FromString(record.numpy())
            logs[scenario.scenario_id] = scenario
    valid, scores, metadata = [], {}, set()
    for path in sorted(options.shards.iterdir()):
        shard = sim_agents_submission_pb2.SimAgentsChallengeSubmission.FromString(path.read_bytes())
        for rollouts in shard.scenario_rollouts:
            submission_specs.validate_scenario_rollouts(rollouts, logs[rollouts.scenario_id])
            valid.append(rollouts.scenario_id)
            if rollouts.scenario_id in options.score:
                from waymo_open_dataset.wdl_limited.sim_agents_metrics import metrics

                config = sim_agents_metrics_pb2.SimAgentMetricsConfig()
                text = pathlib.Path(metrics.__file__).parent / "challenge_2025_sim_agents_config.textproto"
                text_format.Parse(text.read_text(), config)
                result = metrics.compute_scenario_metrics_for_bundle(config, logs[rollouts.scenario_id], rollouts)
                scores[rollouts.scenario_id] = {f.name: v for f, v in result.ListFields() if f.name != "scenario_id"}
        del shard.scenario_rollouts[:]
        metadata.add(str(shard))
    print(json.dumps({"valid": valid, "scores": scores, "metadata": sorted(metadata)}))


if __name__ == "__main__":
    main()
