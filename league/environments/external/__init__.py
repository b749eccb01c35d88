"""Games that run in simulators, which connect to a gateway of the process that needs episodes."""
