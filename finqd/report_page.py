"""One self-contained HTML file from what a report says: template, style and scripts of ``finqd/page`` put together.

Whatever comes from files reaches the page as JSON in a script element that no browser runs, and from there as text
nodes only; a content security policy names the one script and the one style by their hashes and allows no network.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent / "page"
#: in the order in which they are read
SCRIPTS = (
    "viewer.js", "drawing.js", "map.js", "charts.js", "parallel.js", "designs.js", "tables.js", "page.js",
)  # fmt: skip


def page(data: Mapping[str, Any], shapes: Mapping[str, Any]) -> str:
    """Return the page as text: ``data`` as `finqd.report.report_data` gives it, shapes as `finqd.report_shapes`."""
    style = (FOLDER / "page.css").read_text(encoding="utf-8")
    body = "\n".join((FOLDER / name).read_text(encoding="utf-8") for name in SCRIPTS)
    script = f'(() => {{\n"use strict";\n{body}\n}})();\n'
    parts = {
        "title": escape(str(data["name"])), "style": style, "script": script,
        "style_hash": _hash(style), "script_hash": _hash(script), "data": inert(data), "shapes": inert(shapes),
    }  # fmt: skip
    template = (FOLDER / "page.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)


def inert(value: Any) -> str:
    """Return JSON that cannot end the element it stands in, nor begin a comment there.

    >>> inert({"name": "</script><!--"})
    '{"name":"\\\\u003c/script\\\\u003e\\\\u003c!--"}'
    """
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def _hash(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode()
