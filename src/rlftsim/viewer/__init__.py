"""Pictures and pages of scenarios and rollouts: stills, films, charts, and a player for browsers and notebooks."""
