"""The page's own script in viewers' browsers. It speaks through boxes of the page: what it says passes all guards."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import viser
from viser._messages import RunJavascriptMessage

Hear = Callable[[object, viser.ClientHandle | None], None]


def add_script(server: viser.ViserServer, hear: Mapping[str, Hear]) -> None:
    """Run `browser.js` in every browser that opens the page.

    Args:
        server: The page. Boxes are added in its present container, which must always be open; the script hides them.
        hear: What takes what was typed into each box, by the names that the script has for boxes.
    """
    boxes = {}
    for name, act in hear.items():
        box = server.gui.add_text(name, "")

        async def update(event: viser.GuiEvent[Any], act: Hear = act) -> None:
            if event.client_id is not None:
                text = event.target.value
                if text:
                    event.target.value = ""  # heard
                    act(text, event.client)

        box.on_update(update)
        boxes[name] = box._impl.uuid
    source = Path(__file__).with_name("browser.js").read_text(encoding="utf-8")
    server._websock_server.queue_message(RunJavascriptMessage(f"const BOXES = {json.dumps(boxes)};\n{source}"))


def reload(server: viser.ViserServer) -> None:
    """Have all browsers that show the page open it anew, without what its URL said: they lay out afresh what has
    changed as a whole."""
    for client in server.get_clients().values():
        client._websock_connection.queue_message(RunJavascriptMessage("location.replace(location.pathname)"))
