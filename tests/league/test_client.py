import pytest

import policy_league_client
from league import client
from league.client import pettingzoo
from policy_league_client.pettingzoo import play


def test_the_client_is_available_under_both_names() -> None:
    assert [getattr(client, name) for name in policy_league_client.__all__] == [
        getattr(policy_league_client, name) for name in policy_league_client.__all__
    ]
    assert pettingzoo.play is play


def test_an_unknown_name_of_the_client_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'policy_league_client' has no attribute 'Klient'"):
        policy_league_client.Klient  # noqa: B018
