"""The policy server on Ray Serve: HTTP API, gRPC, streams and web pages."""
