"""Helpers shared by the tests of several packages: leagues, environments, servers, and waiting for conditions."""
