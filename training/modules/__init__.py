"""Neural networks as RLModules: actor-critic, Q-networks, MADDPG, QMIX, encoders and recurrent layers."""
