"""Named full configurations: functions that return dataclasses, no logic."""
