"""Two nodes of ROS 2 that share no code: `python ros2_nodes.py sdk|pamoja VEHICLE OTHER`.

Each publishes and hears `/cmd_vel`, serves `/VEHICLE/add` and asks `/OTHER/add`, until the vehicle ends it.
"""

import os
import struct
import sys
import time
from typing import Any

import zenoh

TWIST = "geometry_msgs/msg/Twist"
TWIST_HASH = "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"
ADD = "example_interfaces/srv/AddTwoInts"
ADD_HASH = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
PAMOJA_GID = bytes(range(16))
FIRST_OF_PAMOJA = 1000
"""Its messages have numbers from here on, those of the other from 0 on."""
PERIOD_S = 0.1
CDR = b"\x00\x01\x00\x00"


def say(*words: object) -> None:
    sys.stdout.write(f"{' '.join(map(str, words))}\n")  # at once: print would let other threads into the line
    sys.stdout.flush()


def sdk(own: str, other: str) -> None:
    """Do it with zenoh-ros2-sdk, which has it all."""
    from rosbags.typesys import Stores, get_typestore
    from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2ServiceServer, ROS2Subscriber, ZenohSession

    definition, _ = get_typestore(Stores.ROS2_JAZZY).generate_msgdef(TWIST, ros_version=2)
    twist = {"msg_type": TWIST, "msg_definition": definition, "type_hash": TWIST_HASH, "node_name": own}
    add = {"srv_type": ADD, "request_definition": "int64 a\nint64 b", "response_definition": "int64 sum"}
    add |= {"type_hash": ADD_HASH, "node_name": own}

    def serve(request: Any) -> Any:
        return server.response_msg_class(sum=request.a + request.b)

    publisher = ROS2Publisher("/cmd_vel", **twist)
    say("gid", publisher.publisher_gid.hex())
    ROS2Subscriber("/cmd_vel", callback=lambda message: say("heard", int(message.linear.x)), **twist)
    server = ROS2ServiceServer(f"/{own}/add", callback=serve, **add)
    client = ROS2ServiceClient(f"/{other}/add", timeout=0.5, **add)
    vector = ZenohSession.get_instance().store.types["geometry_msgs/msg/Vector3"]
    for number in range(FIRST_OF_PAMOJA):
        publisher.publish(linear=vector(x=float(number), y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0))
        if number % 5 == 0 and (answer := client.call(a=number, b=1)) is not None:
            say("answered", number, answer.sum)
        time.sleep(PERIOD_S)


def pamoja(own: str, other: str) -> None:
    """Do it with Zenoh alone, and with pamoja-ros2 for names, keys and CDR."""
    from pamoja import ros2

    session = zenoh.open(zenoh.Config.from_env())
    domain = int(os.environ["ROS_DOMAIN_ID"])
    topic = ros2.entity_key(domain, "/cmd_vel", TWIST, TWIST_HASH)
    inside = ros2.entity_key(domain, "/tf", TWIST, TWIST_HASH)
    service, asked = (ros2.entity_key(domain, f"/{name}/add", ADD, ADD_HASH) for name in (own, other))
    assert topic and inside and service and asked

    def hear(sample: zenoh.Sample) -> None:
        twist = ros2.twist_from_cdr(list(sample.payload.to_bytes()))
        assert twist is not None and sample.attachment is not None
        say("heard", int(twist[0][0]), sample.attachment.to_bytes().hex())

    def serve(query: zenoh.Query) -> None:
        with query:
            assert query.payload is not None
            a, b = struct.unpack("<4xqq", query.payload.to_bytes())
            query.reply(query.key_expr, CDR + struct.pack("<q", a + b), attachment=query.attachment)

    def see(sample: zenoh.Sample) -> None:
        say("token", "there" if sample.kind == zenoh.SampleKind.PUT else "gone", sample.key_expr)

    session.declare_subscriber(topic, hear)
    session.declare_queryable(service, serve, complete=True)
    session.liveliness().declare_subscriber(f"@ros2_lv/{domain}/**", see, history=True)
    for name in ("clock", "vnet/fix"):
        session.declare_subscriber(
            f"{domain}/{name}/**", lambda sample: say("own", sample.key_expr, sample.payload.to_bytes().hex())
        )
    place, node = f"@ros2_lv/{domain}/{session.zid()}/0", f"%/%/{own}"
    tokens = [session.liveliness().declare_token(f"{place}/0/NN/{node}")]
    for number, (kind, key) in enumerate([("MP", topic), ("SS", service)], start=1):
        _, *path, dds_name, type_hash = key.split("/")
        named = f"{ros2.percent_mangle('/' + '/'.join(path))}/{dds_name}/{type_hash}/::,10:,:,:,,"
        tokens.append(session.liveliness().declare_token(f"{place}/{number}/{kind}/{node}/{named}"))
    for number in range(FIRST_OF_PAMOJA):
        attachment = struct.pack("<qqB16s", number, time.time_ns(), 16, PAMOJA_GID)
        twist = bytes(ros2.twist_to_cdr((float(FIRST_OF_PAMOJA + number), 0, 0), (0, 0, 0)))
        for key in (topic, inside):
            session.put(key, twist, attachment=attachment)
        if number % 5 == 0:
            request = CDR + struct.pack("<qq", number, 1)
            target = zenoh.QueryTarget.ALL_COMPLETE
            for reply in session.get(asked, target=target, payload=request, attachment=attachment):
                assert reply.ok is not None and reply.ok.attachment is not None
                (total,) = struct.unpack("<4xq", reply.ok.payload.to_bytes())
                say("answered", number, total, reply.ok.attachment.to_bytes().hex())
        time.sleep(PERIOD_S)


if __name__ == "__main__":
    {"sdk": sdk, "pamoja": pamoja}[sys.argv[1]](*sys.argv[2:])
