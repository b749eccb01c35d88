"""The `league` command line interface. Each command parses its arguments, calls one function and prints the result."""
