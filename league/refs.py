"""References to versions, policies, scripts and remote models, which the client parses too."""

from policy_league_client.refs import *
