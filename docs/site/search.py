"""Search of the built pages: prose first. Of the API reference names alone are searched, not its descriptions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mkdocs.plugins import event_priority


@event_priority(-100)  # after the search plugin has written its index
def on_post_build(config: Any, **_: Any) -> None:
    """Remove the text of the API reference from the index of the search."""
    index = Path(config["site_dir"]) / "search" / "search_index.json"
    content = json.loads(index.read_text(encoding="utf-8"))
    for entry in content["docs"]:
        if entry["location"].startswith(("reference/", "public_names")):
            entry["text"] = ""
    index.write_text(json.dumps(content), encoding="utf-8")
