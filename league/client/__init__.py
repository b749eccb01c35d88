"""The Python client, which is also installed without the rest of the project: `policy_league_client`."""

from policy_league_client import *
