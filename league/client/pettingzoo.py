"""Play PettingZoo environments against a policy server: `policy_league_client.pettingzoo`."""

from policy_league_client.pettingzoo import *
