"""A configuration and an interface for schedules."""

from league.environments.building import interface
from tests.support.leagues.tictactoe import config

CONFIG = config()

INTERFACE = interface(CONFIG)
