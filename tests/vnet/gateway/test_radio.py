"""Programs that import zenoh, at the radio of a simulated run."""

import gc
import re
from collections import Counter

import pytest

from tests.vnet.gateway.conftest import Drive, events, log
from vnet.errors import ScenarioError

pytestmark = pytest.mark.slow

TALK = """
    import sys, time, zenoh
    session = zenoh.open(zenoh.Config.from_env())
    session.declare_subscriber("car/*/pose", lambda s: print("heard", s.key_expr, s.payload.to_string(), s.kind))
    publisher = session.declare_publisher(f"car/{sys.argv[1]}/pose")
    for number in range(10):
        publisher.put(str(number))
        time.sleep(0.1)
    publisher.delete()
    time.sleep(0.5)
    """


@pytest.mark.parametrize("order", ["fifo", "shuffle"])
def test_receivers_are_given_what_the_radio_delivers_and_it_replays(drive: Drive, order: str) -> None:
    first, again = (drive(TALK, vehicles=3, loss=0.3, run={"order": order}) for _ in range(2))
    assert first.verdict == "valid"
    for node in ("v01", "v02", "v03"):
        assert log(first, node) == log(again, node)
        heard = Counter(line.split("/")[1] for line in log(first, node) if line.startswith("heard"))
        assert heard[node] == 11, "a session hears itself past the radio"
        rows = [row for row in first.trace.to_pylist() if row["receiver"] == node and row["outcome"] == "delivered"]
        assert {other: heard[other] for other in heard if other != node} == Counter(row["sender"] for row in rows)
    assert any("SampleKind.DELETE" in line for line in log(first))


def test_what_one_program_puts_arrives_in_that_order(drive: Drive) -> None:
    """Puts and deletes of any size, with queries among them, do: Zenoh promises it of each publisher."""
    text = """
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config())
        session.declare_subscriber("k/**", lambda s: print(s.key_expr, s.kind))
        queryable = session.declare_queryable("q/**", lambda query: print(query.key_expr, "query"))
        time.sleep(0.1)
        if sys.argv[1] == "v01":
            for n in range(12):
                session.put(f"k/{n}", bytes(n * 200))
                session.delete(f"k/{n}")
                session.get(f"q/{n}", lambda reply: None)
        time.sleep(1.5)
        """
    run = drive(text, vehicles=2)
    kinds = ("SampleKind.PUT", "SampleKind.DELETE", "query")
    expected = [f"{'q' if kind == 'query' else 'k'}/{n} {kind}" for n in range(12) for kind in kinds]
    assert log(run, "v02")[: len(expected)] == expected


def test_many_tokens_of_one_instant_are_two_messages(drive: Drive) -> None:
    """And all are gone at once if their program ends: a message for each would fill the queue."""
    text = """
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config())
        session.liveliness().declare_subscriber("alive/**", lambda s: print(s.key_expr, s.kind))
        session.declare_subscriber("data", lambda s: print(s.payload.to_string()))
        if sys.argv[1] == "v01":
            time.sleep(0.1)
            tokens = [session.liveliness().declare_token(f"alive/{n}") for n in range(50)]
            session.put("data", "after them")
            time.sleep(0.1)
            session.close()
        else:
            time.sleep(0.9)
        """
    run = drive(text, vehicles=2)
    lines = log(run, "v02")
    there, gone = ({f"alive/{n} SampleKind.{kind}" for n in range(50)} for kind in ("PUT", "DELETE"))
    assert set(lines[:50]) == there and lines[50] == "after them" and set(lines[51:]) == gone
    assert len(run.trace) <= 9


def test_what_crosses_has_a_timestamp_of_its_vehicles_router(drive: Drive) -> None:
    """Also a delete, which has none in its own vehicle: the routers of receivers would give it theirs."""
    text = """
        import sys, time, zenoh
        session, other = zenoh.open(zenoh.Config()), zenoh.open(zenoh.Config())
        other.declare_subscriber("k", lambda s: print(s.kind, s.timestamp and str(s.timestamp.get_id())))
        print(session.info.routers_zid()[0])
        if sys.argv[1] == "v01":
            session.put("k", "x")
            session.delete("k")
        time.sleep(0.5)
        """
    run = drive(text, vehicles=2)
    (router, *own), (_, *heard) = log(run, "v01"), log(run, "v02")
    assert own[:2] == [f"SampleKind.PUT {router}", "SampleKind.DELETE None"]
    assert heard[:2] == [f"SampleKind.PUT {router}", f"SampleKind.DELETE {router}"]


def test_times_follow_those_that_are_heard_but_for_those_too_far_ahead(drive: Drive) -> None:
    """Zenoh's clock is a hybrid logical one: who answers a sample has a later time, whatever clocks show."""
    text = """
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config())
        hear = lambda s: print(bytes(s.timestamp.get_id()) == b"me", session.new_timestamp() > s.timestamp)
        session.declare_subscriber("k", hear)
        for ahead_s in (-9, 0.4, 0.6) if sys.argv[1] == "v01" else ():
            at = zenoh.NTP64(*divmod(time.time_ns() + int(ahead_s * 1e9), 10**9))
            session.put("k", "x", timestamp=zenoh.Timestamp(at, b"me"))
            time.sleep(0.1)
        time.sleep(0.5)
        """
    heard = log(drive(text, vehicles=2), "v02")
    assert heard == ["True True", "True True", "False True"]


def test_replies_of_others_have_the_querys_priority_and_a_replier(drive: Drive) -> None:
    """Only a queryable of the asking session says itself whether its reply is express, as with Zenoh."""
    text = """
        import sys, time, zenoh
        me, session = sys.argv[1], zenoh.open(zenoh.Config())

        def answer(query):
            with query:
                query.reply(f"k/{me}", me, express=True)

        queryable = session.declare_queryable(f"k/{me}", answer)
        time.sleep(0.1)
        if me == "v01":
            for options in ({}, {"priority": zenoh.Priority.REAL_TIME, "express": True}):
                for reply in sorted(session.get("k/*", **options), key=lambda reply: str(reply.ok.key_expr)):
                    sample, replier = reply.ok, reply.replier_id
                    own = replier == queryable.id
                    print(sample.payload.to_string(), sample.express, sample.priority, own, replier.eid)
        time.sleep(3.0)
        """
    run = drive(text, vehicles=2, duration_s=4.0)
    assert log(run)[:4] == [
        "v01 True Priority.DATA True 1",
        "v02 False Priority.DATA False 0",
        "v01 True Priority.REAL_TIME True 1",
        "v02 True Priority.REAL_TIME False 0",
    ]


@pytest.mark.parametrize(("history", "told"), [(True, ["live/v02"]), (False, [])])
def test_a_token_that_was_heard_before_is_history(drive: Drive, history: bool, told: list[str]) -> None:
    text = f"""
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config())
        if sys.argv[1] == "v02":
            token = session.liveliness().declare_token("live/v02")
        else:
            time.sleep(0.3)
            print("listens")
            hear = lambda sample: print(sample.key_expr)
            session.liveliness().declare_subscriber("live/**", hear, history={history})
        time.sleep(2)
        """
    run = drive(text, vehicles=2, duration_s=1.5)
    assert log(run) == ["listens", *told]


def test_without_any_key_nothing_crosses(drive: Drive) -> None:
    run = drive(TALK, vehicles=2, radio={"keys": []})
    assert run.trace.num_rows == 0
    assert not any("car/v02" in line for line in log(run, "v01"))


def test_replies_go_to_the_asker_alone(drive: Drive) -> None:
    """Queries of two vehicles have the same number."""
    text = """
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config())
        if sys.argv[1] == "v01":
            def answer(query):
                query.reply("echo", query.payload)
                query.drop()
            queryable = session.declare_queryable("echo", answer)
            time.sleep(1.8)
        else:
            time.sleep(0.2)
            all_of_them = zenoh.ConsolidationMode.NONE
            replies = session.get("echo", payload=sys.argv[1], consolidation=all_of_them, timeout=1)
            print([reply.ok.payload.to_string() for reply in replies if reply.ok])
        """
    run = drive(text, vehicles=3)
    assert [log(run, node)[0] for node in ("v02", "v03")] == ["['v02']", "['v03']"]


def test_keys_keep_samples_inside_and_sessions_of_a_vehicle_talk_past_the_radio(drive: Drive) -> None:
    text = """
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config())
        session.declare_subscriber("**", lambda s: print("heard", s.key_expr))
        time.sleep(0.1)
        if sys.argv[1] == "v01":
            for key in ("pose/a", "lidar/a", "vnet/own"):
                session.put(key, b"x")
        time.sleep(0.5)
        """
    run = drive(
        text,
        """
        import time, zenoh
        with zenoh.open(zenoh.Config()) as session, session.declare_subscriber("*/*") as subscriber:
            time.sleep(0.5)
            while (sample := subscriber.try_recv()) is not None:
                print("inside", sample.key_expr)
        """,
        vehicles=2,
        radio={"keys": ["pose/**"]},
    )
    inside = {line for line in log(run) if line.startswith("inside")}
    assert inside - {"inside vnet/fix"} == {"inside pose/a", "inside lidar/a", "inside vnet/own"}
    assert {line for line in log(run, "v02") if line.endswith("/a")} == {"heard pose/a", "inside pose/a"}
    assert len(run.trace) == 1


def test_replies_of_keys_that_stay_inside_do_not_cross(drive: Drive) -> None:
    text = """
    import sys, time, zenoh
    session = zenoh.open(zenoh.Config())
    def reply(query):
        for key in ("vnet/fix", "lidar/points", "car/a", "other/b"):
            query.reply(key, b"x")
    if sys.argv[1] == "v02":
        session.declare_queryable("**", reply)
        time.sleep(2)
    else:
        time.sleep(0.5)
        for answer in session.get("**", consolidation=zenoh.ConsolidationMode.NONE):
            print(answer.ok.key_expr if answer.ok else "error")
    """
    run = drive(text, vehicles=2, radio={"keys": ["car/**", "other/*"]})
    assert log(run)[:2] == ["car/a", "other/b"] and len(run.trace) == 3


def test_queries_replies_and_errors_cross_the_radio(drive: Drive) -> None:
    text = """
        import sys, time, zenoh
        me, session = sys.argv[1], zenoh.open(zenoh.Config())

        def answer(query):
            with query:
                if me == "v02":
                    query.reply("state/v02", query.payload, attachment=b"note", encoding="text/plain")
                    query.reply_del("state/gone")
                else:
                    query.reply_err(f"{me}: {query.parameters}")

        time.sleep(0.1)
        if me == "v01":
            started = time.monotonic()
            for reply in session.get("state/*?x=1", payload="asked", consolidation=zenoh.ConsolidationMode.NONE):
                if reply.ok is not None:
                    print(reply.ok.key_expr, reply.ok.kind, reply.ok.payload.to_string(), reply.ok.encoding)
                else:
                    print("error", reply.err.payload.to_string())
            print("over", round(time.monotonic() - started, 3))
            try:
                print(session.get("state/nobody", timeout=0.2).recv().err.payload.to_string())
            except zenoh.ZError:
                print("nobody")
        else:
            queryable = session.declare_queryable("state/*", answer)
            time.sleep(1.5)
        """
    run = drive(text, vehicles=3, program={"zenoh": {"query_s": 0.5}}, duration_s=3.0)
    lines = log(run)
    samples = ["state/gone SampleKind.DELETE  zenoh/bytes", "state/v02 SampleKind.PUT asked text/plain"]
    assert sorted(lines[:3]) == ["error v03: x=1", *samples]
    assert lines[3].startswith("over 0.5")
    assert lines[4].startswith("v0") or lines[4] == "Timeout"


def test_a_reply_to_a_query_of_a_killed_program_is_none_to_one_of_its_next_life(drive: Drive) -> None:
    text = """
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config())
        if sys.argv[1] == "v02":
            def answer(query):
                time.sleep(0.7)
                query.reply("k", query.payload)
            session.declare_queryable("k", answer)
        else:
            asked = f"{time.monotonic():.1f}"
            every = zenoh.ConsolidationMode.NONE
            for reply in session.get("k", payload=asked, timeout=1.9, consolidation=every):
                print(asked, reply.ok.payload.to_string())
        time.sleep(9)
        """
    run = drive(
        text,
        vehicles=2,
        duration_s=4.0,
        fault=[{"kind": "kill", "at_s": 0.4, "duration_s": 0.2, "nodes": ["v01"]}],
    )
    assert log(run)[:1] == ["0.6 0.6"]


def test_a_query_crosses_beside_complete_queryables_of_the_own_vehicle(drive: Drive) -> None:
    """Zenoh's router asks the nearest complete queryable, and one of its own, as a gateway has."""
    serve = """
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config())
        session.declare_queryable("c/**", lambda query: query.reply("c", sys.argv[1]), complete=True)
        time.sleep(9)
        """
    ask = """
        import time, zenoh
        session = zenoh.open(zenoh.Config())
        time.sleep(0.1)
        replies = session.get("c/**", consolidation=zenoh.ConsolidationMode.NONE)
        print(sorted(reply.ok.payload.to_string() for reply in replies))
        """
    run = drive(serve, ask, vehicles=2)
    assert log(run)[:1] == ["['v01', 'v02']"]


@pytest.mark.parametrize("offset_ms", [2500.0, -60000.0])
def test_a_clock_fault_changes_no_token(drive: Drive, offset_ms: float) -> None:
    text = """
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config())
        token = session.liveliness().declare_token(f"alive/{sys.argv[1]}")
        tell = lambda token: print(token.key_expr, token.kind)
        session.liveliness().declare_subscriber("alive/v03", tell, history=True)
        time.sleep(99)
        """
    run = drive(
        text,
        vehicles=3,
        duration_s=9.0,
        fault=[
            {"kind": "skew", "at_s": 2.5, "duration_s": 6.4, "nodes": ["v02"], "offset_ms": offset_ms},
            {"kind": "kill", "at_s": 4.0, "duration_s": 5.0, "nodes": ["v03"]},
        ],
    )
    assert log(run, "v02")[:3] == log(run, "v01")[:3] == ["alive/v03 SampleKind.PUT", "alive/v03 SampleKind.DELETE"]


def test_tokens_come_by_the_radio_and_go_with_a_vehicle_that_is_killed(drive: Drive) -> None:
    text = """
        import sys, time, zenoh
        me, session = sys.argv[1], zenoh.open(zenoh.Config())
        if me == "v01":
            time.sleep(0.42)
            print([str(reply.ok.key_expr) for reply in session.liveliness().get("alive/*")])
            tell = lambda s: print(round(time.monotonic(), 1), s.key_expr, s.kind)
            session.liveliness().declare_subscriber("alive/*", tell, history=True)
            time.sleep(5)
        else:
            token = session.liveliness().declare_token(f"alive/{me}")
            time.sleep(2.0)
            token.undeclare()
            time.sleep(5)
        """
    run = drive(
        text,
        vehicles=3,
        duration_s=5.0,
        program={"zenoh": {"liveliness_s": 0.2}},
        fault=[{"kind": "kill", "at_s": 1.0, "duration_s": 3.9, "nodes": ["v03"]}],
    )
    assert log(run)[:5] == [
        "['alive/v02', 'alive/v03']",
        "0.4 alive/v02 SampleKind.PUT",
        "0.4 alive/v03 SampleKind.PUT",
        "1.4 alive/v03 SampleKind.DELETE",
        "2.0 alive/v02 SampleKind.DELETE",
    ]


def test_tokens_are_those_of_the_latest_word_whatever_overtakes_it(drive: Drive) -> None:
    text = """
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config())
        tell = lambda s: print(s.key_expr, str(s.kind))
        watch = session.liveliness().declare_subscriber("alive/*", tell)
        time.sleep(0.5)
        if sys.argv[1] == "v01":
            tokens = []
            for number in range(6):
                tokens.append(session.liveliness().declare_token(f"alive/{number}"))
                time.sleep(0.001)
            time.sleep(1.0)
            for token in tokens:
                token.undeclare()
                time.sleep(0.001)
        time.sleep(5)
        """
    lines = log(drive(text, vehicles=2, duration_s=2.5, radio={"jitter_ms": 20.0}), "v02")
    there = [line for line in lines if line.endswith("PUT")]
    gone = [line for line in lines if line.endswith("DELETE")]
    assert lines == [*there, *gone] and len(set(there)) == len(set(gone)) == len(there) == len(gone) == 6


def test_large_sample_crosses_in_fragments(drive: Drive) -> None:
    text = """
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config())
        with session.declare_subscriber("big", zenoh.handlers.RingChannel(1)) as subscriber:
            time.sleep(0.1)
            if sys.argv[1] == "v01":
                session.put("big", bytes(range(256)) * 40)
            sample = subscriber.recv()
            print(len(sample.payload), sample.payload.to_bytes() == bytes(range(256)) * 40)
        """
    run = drive(text, vehicles=2)
    assert log(run, "v02")[0] == "10240 True"
    assert len(run.trace) > 6


RECOVER = """
    import sys, time, zenoh
    from datetime import timedelta
    from zenoh.ext import *
    session = zenoh.open(zenoh.Config())
    if sys.argv[1] == "v01":
        publisher = declare_advanced_publisher(
            session, "count", cache=CacheConfig(max_samples=100), publisher_detection=True,
            sample_miss_detection=MissDetectionConfig(heartbeat=0.1),
        )
        for number in range(40):
            publisher.put(z_serialize(number))
            time.sleep(0.05)
        time.sleep(10)
    else:
        time.sleep(0.3)
        subscriber = declare_advanced_subscriber(
            session, "count", lambda s: print("heard", z_deserialize(int, s.payload), s.source_info.source_sn),
            history=HistoryConfig(detect_late_publishers=True) if {history} else None,
            recovery=RecoveryConfig({recovery}) if "{recovery}" else None,
        )
        subscriber.sample_miss_listener(lambda miss: print("missed", miss.nb))
        time.sleep(10)
    """


@pytest.mark.parametrize("recovery", ["heartbeat=True", "periodic_queries=timedelta(seconds=0.2)"])
def test_advanced_subscriber_recovers_most_of_what_the_radio_loses_in_order(drive: Drive, recovery: str) -> None:
    # Zenoh gives up what lies before a query's end: queries over the radio must end before the next begins.
    zenoh = {"zenoh": {"query_s": 0.1}}
    text = RECOVER.format(history=True, recovery=recovery)
    run = drive(text, vehicles=2, loss=0.3, duration_s=9.0, program=zenoh)
    lost = sum(row["outcome"] == "lost" and row["receiver"] == "v02" for row in run.trace.to_pylist())
    heard = [int(line.split()[1]) for line in log(run, "v02") if line.startswith("heard")]
    missed = sum(int(line.split()[1]) for line in log(run, "v02") if line.startswith("missed"))
    assert heard == sorted(set(heard)), "in order, each once"
    assert heard[-1] == 39
    assert len(heard) + missed == 40 - heard[0]
    assert missed < lost / 2
    assert heard[0] < 5, "the history is there, up to what its frames have lost"


@pytest.mark.parametrize("recovery", ["", "heartbeat=True"])
def test_history_is_whole_although_queries_stay_open(drive: Drive, recovery: str) -> None:
    """A vehicle that is restarted hears of a token while it asks all caches, and then asks that one by itself."""
    restarts = [
        {"kind": "restart", "at_s": 0.2, "duration_s": 0.1 * number, "nodes": [f"v0{number}"]}
        for number in (2, 3, 4, 5)
    ]
    run = drive(RECOVER.format(history=True, recovery=recovery), vehicles=5, duration_s=4.0, fault=restarts)
    for node in ("v02", "v03", "v04", "v05"):
        heard = [line.split()[1] for line in log(run, node) if line.startswith("heard")]
        assert heard == [str(number) for number in range(40)]


def test_sample_miss_listener_reports_exactly_what_the_radio_has_lost(drive: Drive) -> None:
    run = drive(RECOVER.format(history=False, recovery=""), vehicles=2, loss=0.3, duration_s=4.0)
    heard = [int(line.split()[2]) for line in log(run, "v02") if line.startswith("heard")]
    missed = sum(int(line.split()[1]) for line in log(run, "v02") if line.startswith("missed"))
    assert missed == heard[-1] - heard[0] + 1 - len(heard) > 0


def test_fixes_and_reports_go_by_own_keys(drive: Drive) -> None:
    run = drive("""
        import msgpack, zenoh
        session = zenoh.open(zenoh.Config())
        subscriber = session.declare_subscriber("vnet/fix")
        for sample in subscriber:
            fix = msgpack.unpackb(sample.payload.to_bytes())
            session.put("vnet/report", msgpack.packb({"estimate_m": fix["position_m"], "seen": 1}))
        """)
    assert run.verdict == "valid"
    assert (run.reported("seen") == 1).all(), "also that of the instant at which programs begin"
    assert len(run.trace) == 0


def test_command_that_is_no_python_and_keys_that_overlap_are_refused_by_name(drive: Drive) -> None:
    with pytest.raises(ScenarioError, match=r"program\.command = 'talker x'"):
        drive("", program={"command": ["talker", "x"]})
    with pytest.raises(ScenarioError, match=r"radio\.keys.*'a/\*\*' and 'a/b' overlap"):
        drive("", radio={"keys": ["a/**", "a/b"]})


ALL_KINDS = """
    import sys, threading, time, zenoh
    from zenoh.ext import *
    me, session = sys.argv[1], zenoh.open(zenoh.Config())
    kept = [
        session.declare_subscriber("**"),
        session.liveliness().declare_subscriber("**", history=True),
        session.liveliness().declare_token(f"alive/{me}"),
        session.declare_queryable("asked"),
        declare_advanced_subscriber(
            session, "**", history=HistoryConfig(detect_late_publishers=True),
            recovery=RecoveryConfig(heartbeat=True),
        ),
        declare_advanced_publisher(
            session, f"count/{me}", cache=CacheConfig(max_samples=5), publisher_detection=True,
            sample_miss_detection=MissDetectionConfig(heartbeat=0.1),
        ),
        session.declare_publisher(f"car/{me}").declare_matching_listener(),
    ]
    threading.Thread(target=lambda: [print("never") for reply in session.get("asked")]).start()
    with session:
        while True:
            kept[5].put(b"x" * 3000)
            time.sleep(0.05)
    """


def test_nothing_is_raised_where_vehicles_are_killed_or_the_run_ends_in_the_middle(
    drive: Drive, capfd: pytest.CaptureFixture[str]
) -> None:
    faults = [
        {"kind": "kill", "at_s": 0.52, "duration_s": 0.5, "nodes": ["v01"]},
        {"kind": "restart", "at_s": 0.83, "duration_s": 0.2, "nodes": ["v02"]},
    ]
    run = drive(ALL_KINDS, vehicles=3, duration_s=1.53, fault=faults)
    gc.collect()
    assert (events(run, "exception"), events(run, "crashed")) == ([], [])
    assert not re.search("ignored|Traceback|never", capfd.readouterr().err)


def test_frames_that_a_fault_has_changed_are_dropped(drive: Drive) -> None:
    fault = {"kind": "corrupt", "at_s": 0.0, "duration_s": 2.0, "probability": 0.7}
    run = drive(ALL_KINDS, vehicles=2, fault=[fault])
    assert (events(run, "exception"), events(run, "crashed")) == ([], [])
    assert any("is no sample" in event["text"] for event in events(run, "log"))


def test_a_sample_that_cannot_arrive_is_told(drive: Drive) -> None:
    program = """
        import time, zenoh
        with zenoh.open(zenoh.Config()) as session:
            session.put("image", bytes(90_000))
            time.sleep(1)
        """
    assert "which cannot arrive: radio.queue_frames = 64" in log(drive(program))[0]


@pytest.mark.parametrize(
    ("keys", "key", "told"),
    [(["car/**"], "car/@v0/x", True), (["car/@v0/**"], "car/@v0/x", False), (["car/**"], "bus/@v0/x", False)],
)
def test_a_key_that_wildcards_seem_to_include_is_told_once(
    drive: Drive, keys: list[str], key: str, told: bool
) -> None:
    """Wildcards stand for no part that begins with @: programs whose keys have one sent nothing, without a word."""
    program = f"""
        import time, zenoh
        with zenoh.open(zenoh.Config()) as session:
            for number in range(3):
                session.put(f"{key}/{{number}}", b"")
            time.sleep(1)
        """
    assert sum("stays in the vehicle" in line for line in log(drive(program, radio={"keys": keys}))) == told
