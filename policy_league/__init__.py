"""What the `league` command consists of beside its libraries: subcommands, bundled configurations and example games."""
