import pytest

from league.errors import ArtifactCorrupt
from league.registry.storage.manifest import Manifest


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"league": "board"', "file: not valid JSON: EOF while parsing an object at line 1 column 18"),
        ("[]", "file: expected a mapping, got []"),
        ('{"league": 5}', "league: expected a string, got 5; version: missing, but required; "),
    ],
)
def test_a_manifest_that_is_not_valid_is_named_with_its_first_faults(text: str, message: str) -> None:
    with pytest.raises(ArtifactCorrupt) as caught:
        Manifest.from_json(text, "board/1/manifest.json")
    assert str(caught.value).startswith(f"board/1/manifest.json: {message}")
