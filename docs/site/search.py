"""The search of the built pages: guides come first, then other prose, then the API reference.

The search looks only at the names in the API reference, not at its descriptions.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.plugins import event_priority

GUIDES = ("Start", "Tutorials", "How to")
"""Groups of the navigation whose pages come first: another page comes before a guide only with a score over BOOST times
as high."""
BOOST = 4.0
_ADD = "this.add(doc);"


@event_priority(-100)  # after the search plugin has written its index
def on_post_build(config: Any, **_: Any) -> None:
    """Remove the text of the API reference from the index of the search, and weigh guides."""
    folder = Path(config["site_dir"]) / "search"
    content = json.loads((folder / "search_index.json").read_text(encoding="utf-8"))
    guides = tuple(str(Path(page).with_suffix(".html")) for group in config["nav"] for page in _pages_of(group))
    for entry in content["docs"]:
        is_notebook = entry["location"].startswith("notebooks/") and "#" not in entry["location"]
        if is_notebook or entry["location"].startswith(("reference/", "public_names")):
            entry["text"] = ""  # of a notebook: its styles; its sections have entries of their own
        entry["boost"] = BOOST if entry["location"].partition("#")[0] in guides else 1.0
    (folder / "search_index.json").write_text(json.dumps(content), encoding="utf-8")
    worker = (folder / "worker.js").read_text(encoding="utf-8")
    if worker.count(_ADD) != 1:
        raise PluginError(
            f"worker.js of mkdocs has {worker.count(_ADD)} times {_ADD!r}, expected once: guides get no boost"
        )
    weighed = worker.replace(_ADD, "this.add(doc, {boost: doc.boost});")
    (folder / "worker.js").write_text(weighed, encoding="utf-8")


def _pages_of(group: dict[str, Any]) -> list[str]:
    """The pages of a group of the navigation if it holds guides."""
    ((name, below),) = group.items()
    if name not in GUIDES:
        return []
    return [below] if isinstance(below, str) else [page for each in below for page in each.values()]
