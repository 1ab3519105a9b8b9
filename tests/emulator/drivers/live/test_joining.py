"""Joining: what a hello is answered."""

import pytest

from tests.emulator.drivers.live.fakes import Stage, hello, on_a_loop
from vnet.transport import wire


@pytest.mark.parametrize("version", [1, wire.VERSION + 1])
@on_a_loop
async def test_an_agent_of_another_version_is_refused_in_one_line(version: int) -> None:
    stage = Stage()
    stage.live.take("message", "v01", wire.encode(hello("v01", version=version)))
    reason = (
        f"the agent speaks version {version} of the messages, this emulator version {wire.VERSION}: "
        "use the same version of vnet"
    )
    assert stage.attachment.sent == [("v01", wire.End(b"1", reason, refused=True))]
    assert [(e.kind, e.details["reason"]) for e in stage.emulation.folder.events] == [("refused", reason)]
    stage.live.take("message", "v01", wire.encode(hello("v01", ready=False)))
    ((_, welcome),) = stage.attachment.sent[1:]
    assert isinstance(welcome, wire.Welcome) and welcome.version == wire.VERSION
