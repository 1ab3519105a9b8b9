"""A cheating client: it tries what the rules forbid until its standard input closes, then says what it got.

Run as `python cheater.py ENDPOINT RUN`, with `[user, password, victim's user]` as JSON on the first line of its
standard input. It prints `ready` once its first attempts are made, and at the end one line of JSON.
"""

import json
import sys
import threading

import zenoh

from vnet.errors import TransportError
from vnet.radio import SentFrame
from vnet.transport import keys, wire
from vnet.transport.credentials import Credentials
from vnet.transport.session import open_client, quiet_zenoh

VICTIM = "v01"


def try_to_log_in(endpoint: str, credentials: Credentials | None) -> bool:
    """Return True if the router accepts these credentials."""
    try:
        with open_client(endpoint, credentials, 2000):
            return True
    except TransportError:
        return False


def attack(session: zenoh.Session, run: str, seq: int) -> None:
    """One round of forged messages on everybody's keys but its own."""
    end = wire.encode(wire.End(None, "forged"))
    grant = wire.encode(wire.Grant(seq, seq * 100_000_000, seq * 100_000_000 + 1))
    hello = wire.encode(wire.Hello(VICTIM, VICTIM, b"forged", 1, "nowhere", version=wire.VERSION))
    steps = [wire.Step(seq * 100_000_000, wire.Traffic([SentFrame(VICTIM, b"forged")]))]
    yielded = wire.encode(wire.Yield(b"forged", seq, None, [], [], steps, 1))
    for message in (grant, end):
        session.put(keys.node_rx(run, VICTIM), message)
    for message in (hello, yielded, b"not a message"):
        session.put(keys.node_tx(run, VICTIM), message)
        session.put(keys.node_tx(run, "v05"), message)
    session.put(keys.observe(run, "end"), b"")
    session.put(f"vnet/{run}/**", b"forged")


def main() -> None:
    quiet_zenoh()
    endpoint, run = sys.argv[1:]
    user, password, victim_user = json.loads(sys.stdin.readline())
    received: list[str] = []
    over = threading.Event()

    def wait_for_the_end() -> None:
        sys.stdin.read()
        over.set()

    threading.Thread(target=wait_for_the_end, daemon=True).start()
    with open_client(endpoint, Credentials(user, password), 2000) as session:
        for key in ("**", f"vnet/{run}/**", keys.node_rx(run, VICTIM), keys.node_tx(run, VICTIM), "@/**"):
            session.declare_subscriber(
                key, lambda sample: received.append(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE
            )
        logins = {
            "as the victim": try_to_log_in(endpoint, Credentials(victim_user, password)),
            "as nobody": try_to_log_in(endpoint, None),
            "as itself again": try_to_log_in(endpoint, Credentials(user, password)),
        }
        attack(session, run, 0)
        print("ready", flush=True)
        rounds = 1
        while not over.wait(0.002) and session.info.routers_zid():
            attack(session, run, rounds)
            rounds += 1
    print(json.dumps({"received": received, "rounds": rounds, "logins": logins}))


if __name__ == "__main__":
    main()
