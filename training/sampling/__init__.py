"""The EnvRunner on the kernel's lockstep stepping."""
