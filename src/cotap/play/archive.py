"""Where recordings and films are kept, and the page's buttons for them."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import viser

from cotap.evaluation.recording import Recording
from cotap.play.film import film
from cotap.play.notices import Notices, RateLimit
from cotap.play.scene import Scene

DOWNLOAD_S = 10.0
"""A viewer gets the recording this often at most [s]: what a browser does not take waits in memory."""


class Archive:
    """A folder of recordings, numbered; the newest can be filmed and downloaded.

    Args:
        folder: Made when it is first needed.
        notices: Say what was written.
    """

    def __init__(self, folder: Path, notices: Notices) -> None:
        self._folder, self._notices = folder, notices
        self.newest: Recording | None = None
        self.path: Path | None = None
        self.filming = threading.Event()
        """Set while a film is made: the simulation waits then."""
        self.drawing = threading.Lock()
        """Held by whoever draws: a page's loop for one picture, a film until it is done."""
        self._one_film = threading.Lock()
        self._downloads = RateLimit(DOWNLOAD_S)
        self._buttons: list[viser.GuiButtonHandle] = []

    def keep(self, recording: Recording) -> Path:
        """Write a recording under the next free number. Raises OSError if it cannot be written."""
        self._folder.mkdir(parents=True, exist_ok=True)
        number = 1
        while (path := self._folder / f"recording_{number:03d}.npz").exists():
            number += 1
        recording.save(path)
        self.newest, self.path = recording, path
        self._grey(False)
        return path

    def film(self, client: viser.ClientHandle, scene: Scene) -> None:
        """Film the newest recording as `client` sees it, and offer it for download."""
        if self.newest is None or self.path is None:
            self._notices.tell("record something first", client, "nothing to film")
            return
        if not self._one_film.acquire(blocking=False):
            self._notices.tell("a film is being made already", client, "one at a time")
            return
        path = self.path.with_suffix(".mp4")
        try:
            self.filming.set()
            self._grey(True)
            with self.drawing:
                film(client, scene, self.newest, path)
        except OSError as error:
            self._notices.tell(str(error), client, "no film")
        else:
            self._notices.tell(f"written to {path}", client, "film")
            client.send_file_download(path.name, path.read_bytes())
        finally:
            self.filming.clear()
            self._grey(False)
            self._one_film.release()

    def add_buttons(self, gui: viser.GuiApi, scene: Scene) -> None:
        """The film button and the download button, in the present container."""

        def on_film(event: viser.GuiEvent[Any]) -> None:  # takes its time: a thread of the server's, not its loop
            if event.client is not None:
                self.film(event.client, scene)

        def on_download(event: viser.GuiEvent[Any]) -> None:
            if event.client is None or event.client_id is None or self.path is None:
                return
            if not self._downloads.grants(event.client_id):
                self._notices.tell(f"once in {DOWNLOAD_S:g} s", event.client, "it is on its way")
            else:
                event.client.send_file_download(self.path.name, self.path.read_bytes())

        for label, act in (("Film the recording (MP4)", on_film), ("Download the recording", on_download)):
            button = gui.add_button(label, disabled=self.newest is None)
            button.on_click(act)
            self._buttons.append(button)

    def _grey(self, on: bool) -> None:
        """Whether the buttons do nothing."""
        for button in self._buttons:
            button.disabled = on
