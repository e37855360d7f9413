"""Goals of agents: points that they are conditioned on, and the maneuvers behind them."""
