"""Named full configurations: functions that return dataclasses, no logic. The contract is `registry.Recipe`."""
