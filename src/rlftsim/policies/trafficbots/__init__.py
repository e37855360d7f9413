"""TrafficBots V1.5: continuous actions every 0.1 s, a personality and a destination per agent."""
