"""How a local Ray starts: on the loopback interface, with a token of its own, however long it takes."""
