"""Puts the web pages and a report into one HTML file."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path
from secrets import token_urlsafe
from typing import Any

import orjson

from serve_app.routes.pages import DOCUMENT, FILES, MEDIA_TYPES


def report_file(report: Mapping[str, Any]) -> bytes:
    """All pages with a report as one HTML document, which needs no server and works from `file://`.

    Browsers load no modules from files, so an import map contains them as data URLs. A Content-Security-Policy allows
    only scripts and styles with a random nonce, which no text of the report can know.

    Args:
        report: `{"league", "made_at", "documents"}`, as in `pages/report.js`.

    Returns:
        The document in UTF-8.
    """
    files = {
        path.relative_to(FILES).as_posix(): path.read_text(encoding="utf-8")
        for path in FILES.rglob("*")
        if path.suffix in MEDIA_TYPES
    }
    imports = {
        name: _data_url(name, re.sub(r'"\./(?=[\w/-]+\.js")', '"', code))  # data URLs have no relative ones
        for name, code in files.items()
        if name.endswith(".js")
    }
    nonce = token_urlsafe()
    rules = f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src data:; base-uri 'none'"
    policy = f'<meta http-equiv="Content-Security-Policy" content="{rules}; form-action \'none\'">\n'
    data = orjson.dumps(report).decode().replace("<", r"\u003c")  # no text can end its element
    scripts = f"""<script type="importmap" nonce="{nonce}">{orjson.dumps({"imports": imports}).decode()}</script>
<script type="application/json" id="report">{data}</script>
<script type="module" nonce="{nonce}">import "app.js";</script>"""
    page = files[DOCUMENT].replace("<title>", f"{policy}<title>")
    for element, inlined in (
        (r'<link rel="modulepreload".*>\n', lambda _: ""),
        (r"/pages/(logo\.svg)", lambda found: _data_url(found[1], files[found[1]])),
        (
            r'<link rel="stylesheet" href="/pages/(.*)">',
            lambda found: f'<style nonce="{nonce}">{files[found[1]]}</style>',
        ),
        (r'<script src="/pages/(.*)"></script>', lambda found: f'<script nonce="{nonce}">{files[found[1]]}</script>'),
        (r'<script type="module" src="/pages/app\.js"></script>', lambda _: scripts),
    ):
        page = re.sub(element, inlined, page)
    return page.encode()


def _data_url(name: str, text: str) -> str:
    return f"data:{MEDIA_TYPES[Path(name).suffix]};base64,{b64encode(text.encode()).decode()}"
