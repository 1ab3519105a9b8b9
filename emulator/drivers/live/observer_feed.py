"""The messages of a live run to those who observe it; nothing is made while nobody does."""

from __future__ import annotations

from emulator.drivers.attachment import Attachment
from emulator.drivers.emulation import Emulation, PeriodView
from emulator.drivers.observers import Messages

SCENE_EVERY_PERIODS = 50
"""Periods between two messages with the scene, for observers that come late."""


class ObserverFeed:
    """Publishes the scene, each period and the end. The run's own recorder watches from the first period on."""

    def __init__(self, emulation: Emulation, attachment: Attachment) -> None:
        self._attachment = attachment
        self._messages = Messages(emulation)
        self._watched = True

    def begin(self) -> None:
        """Publish the scene."""
        self._attachment.publish("scene", self._messages.scene())

    def period(self, view: PeriodView) -> None:
        """Publish a period. A message is of a whole period: an observer that comes within one gets the next."""
        was_watched, self._watched = self._watched, self._attachment.is_watched("period")
        if not self._watched:
            return
        if not was_watched or view.instant.period % SCENE_EVERY_PERIODS == 0:
            self._attachment.publish("scene", self._messages.scene())
        if was_watched:
            self._attachment.publish("period", self._messages.period(view))
        else:
            self._messages.begin()

    def end(self) -> None:
        """Publish that the run is over."""
        self._attachment.publish("end", self._messages.end())
