from tiny_fixtures import drawn_scenarios, measured, simulated, vocabulary  # noqa: F401
