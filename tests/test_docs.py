"""The code of the documentation runs, and its site works offline. What pages name: `scripts/checks/docs.py`."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def test_the_code_of_the_tutorial_runs(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "docs/vectorised-environments.md").read_text()
    example = "".join((ROOT / "policy_league/examples/kuhn_poker_vector.py").read_text().split())
    names: dict[str, object] = {}
    for block in re.findall(r"^```python\n(.*?)^```", text, flags=re.S | re.M):
        # Methods of the example have another indentation and other line breaks on the page.
        if "".join(block.split()) not in example:
            exec(compile(block, "vectorised-environments.md", "exec"), names)
    printed = capsys.readouterr().out
    outputs = re.findall(r"^```text\n(.*?)^```", text, flags=re.S | re.M)
    assert outputs
    assert [text for text in outputs if text not in printed] == []


@pytest.mark.slow
def test_the_site_is_built_without_warnings(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    assert (tmp_path / "search/search_index.json").exists()
    loaded = [
        link
        for page in tmp_path.rglob("*.html")
        for link in re.findall(r"<(?:script|img|link)[^>]* (?:src|href)=\"?(https?://[^\" >]*)", page.read_text())
    ]
    assert loaded == [], "the site must work offline"
