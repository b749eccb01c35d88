"""The peer: RLlib's example of serving a policy, `rllib/examples/ray_serve`, with a module of the size for connect
four.

`python -m benchmarks.peers.rllib_server CHECKPOINT PORT` serves until its standard input is closed. Its deployment is
the class of the wheel; environment variables select HAProxy and the number of torch threads.
"""

import sys
from pathlib import Path


def save_module(path: Path) -> None:
    """Save an untrained RLModule with a flat board as input and 7 logits."""
    import gymnasium
    import numpy as np
    from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule
    from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
    from ray.rllib.core.rl_module.rl_module import RLModuleSpec

    from benchmarks.leagues.served_league import HIDDEN, PLANES

    spec = RLModuleSpec(
        module_class=DefaultPPOTorchRLModule,
        observation_space=gymnasium.spaces.Box(0, 1, (PLANES.size,), np.float32),
        action_space=gymnasium.spaces.Discrete(7),
        model_config=DefaultModelConfig(fcnet_hiddens=list(HIDDEN)),
    )
    module = spec.build()
    module.save_to_path(str(path))


def main() -> None:
    """Serve, and report when the server is ready."""
    checkpoint, port = sys.argv[1], int(sys.argv[2])
    import ray
    from ray import serve
    from ray.rllib.examples.ray_serve.classes.cartpole_deployment import ServeRLlibRLModule

    ray.init(address="local", include_dashboard=False, namespace="serve", log_to_driver=False)
    serve.start(http_options={"host": "127.0.0.1", "port": port})
    serve.run(ServeRLlibRLModule.bind(checkpoint), route_prefix="/rllib-rlmodule")
    print("up", flush=True)
    sys.stdin.read()
    ray.shutdown()


if __name__ == "__main__":
    main()
