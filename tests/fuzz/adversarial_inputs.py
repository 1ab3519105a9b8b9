"""Handcrafted nasty inputs: what fuzzers rarely come upon by themselves. Every target is given all of them."""

import struct

from tests.fuzz.seeds import OVERRIDE
from vnet.radio import SentFrame
from vnet.transport import wire

_TWO_GB = struct.pack(">I", 2**31)
_HEADERS = {
    "array32": b"\xdd" + _TWO_GB,
    "map32": b"\xdf" + _TWO_GB,
    "bin32": b"\xc6" + _TWO_GB,
    "str32": b"\xdb" + _TWO_GB,
    "ext32": b"\xc9" + _TWO_GB + b"\x01",
}
_DEEP = 100_000


def _msgpack() -> dict[str, bytes]:
    """Return inputs with headers that claim 2 GB, at every position of a value of variable length."""
    whole = {
        "yield": wire.encode(
            wire.Yield(b"n", 1, None, ["a"], [], [wire.Step(2, wire.Traffic([SentFrame("a", b"b")]))], 1)
        ),
        "grant": wire.encode(wire.Grant(1, 2, 3, [wire.WirePacket("a", "b", 1, 2, b"c")])),
        "observation": wire.encode_observation({"a": 1}),
    }
    nasty = {
        f"{name} with {header} at {index}": message[:index] + claim + message[index + 1 :]
        for header, claim in _HEADERS.items()
        for name, message in whole.items()
        for index in range(len(message))
    }
    nasty |= {f"{header} in {header}": claim * 1000 for header, claim in _HEADERS.items()}
    nasty["arrays 10⁵ deep"] = b"\x81\xa1a" + b"\x91" * _DEEP
    nasty["maps 10⁵ deep"] = b"\x81\xa1a" * _DEEP
    nasty["a kind of message as long as a book"] = b"\x91\xda\xff\xff" + b"a\n" * 32767
    nasty["a key as long as a book"] = b"\x81\xda\xff\xff" + b"a\n" * 32767
    return nasty


def _toml() -> dict[str, bytes]:
    deep, many = b"a" + b".a" * _DEEP, b"9" * 5000
    values = {
        "arrays 10⁵ deep": b"[" * _DEEP,
        "closed arrays 500 deep": b"[" * 500 + b"]" * 500,
        "tables 10⁵ deep": b"{a=" * _DEEP,
        "an integer of 5000 digits": many,
        "a hexadecimal integer of 5000 digits": b"0x" + many,
        "a negative integer of 5000 digits": b"-" + many,
        "a float of 5000 digits": many + b"e" + many,
        "an integer beyond 64 bits": b"18446744073709551616",
        "an integer beyond a float": b"1" + b"0" * 400,
        "not a number": b"nan",
        "infinity": b"-inf",
        "a date": b"1979-05-27T07:32:00Z",
        "a time": b"07:32:00",
        "NUL": b'"\\u0000"',
        "a name of 10⁴ characters": b'"' + b"a" * 10_000 + b'"',
        "lines": b'"a\\nb\\u001b[31m"',
        "a table": b"{}",
    }
    keys: tuple[bytes, ...] = (
        b"radio.links", b"radio.max_peers", b"radio.loss", b"run.seed", b"run.name", b"network.path", b"inputs",
    )  # fmt: skip
    keys += (b"program.options.a", b"program.entry")
    nasty = {
        f"{key.decode()} = {name}": key + b" = " + value
        for name, value in values.items()
        for key in (keys[:1] if "10⁵ deep" in name else keys)  # such values are never read to their end
    }
    nasty |= {f"--set {name}": OVERRIDE + key for name, key in zip(nasty, nasty.values(), strict=True)}
    nasty["a network.path of nasty kind"] = b"network = {kind = 'file', path = \"\\u0000\"}"
    nasty["a network.path too long"] = b"network = {kind = 'file', path = '" + b"a" * 5000 + b"'}"
    nasty["inputs that are no table"] = b"inputs = 3\nnetwork = {kind = 'file', path = 'network.csv'}"
    nasty["a key 10⁵ deep"] = deep + b" = 1"
    nasty["a table 10⁵ deep"] = b"[" + deep + b"]"
    nasty["a --set 10⁵ deep"] = OVERRIDE + deep + b" = 1"
    nasty["--set of two values"] = OVERRIDE + b"radio.loss=0.1\nvalue = 3"
    nasty["--set of a broken name"] = OVERRIDE + b"network.path=\xff\xfe" + OVERRIDE + b"network.kind=file"
    nasty["a key with lines"] = b'"a\\nb" = 1'
    nasty["a key of 10⁵ letters"] = b"a" * _DEEP + b" = 1"
    nasty["a key twice"] = b"[run]\nseed = 1\nseed = 2"
    nasty["10⁴ keys"] = b"[program.options]\n" + b"".join(b"a%d = 1\n" % i for i in range(10_000))
    nodes = b", ".join(b"'v%d'" % i for i in range(10_000))
    nasty["exceptions for 10⁴ nodes"] = b"[[program.exceptions]]\nnodes = [" + nodes + b"]"
    nasty["an unknown key in an array of tables"] = b"[[program.exceptions]]\nnodes = ['a']\nx = 1"
    nasty["a period beyond 64 bits"] = b"[world.gnss]\nrate_hz = 1e-300"
    nasty["times beyond 64 bits"] = b"[radio]\nlatency_ms = 1e300"
    nasty["a section with lines"] = b'[world."a\\nb"]\nc = 1'
    return nasty


def _csv() -> dict[str, bytes]:
    header = b"id,x_m,y_m,heading_rad\n"
    return {
        "10⁶ columns": header[:-1] + b",a" * 10**6 + b"\nv,0,0,0\n",
        "a row of 10⁶ zeros": b"0," * 10**6 + b"0\n",
        "10⁵ rows": header + b"".join(b"v%d,0,0,0\n" % i for i in range(10**5)),
        "10⁵ rows of one": b"0\n" * 10**5,
        "a field of 10⁶ characters": header + b"v" * 10**6 + b",0,0,0\n",
        "a number of 10⁵ digits": header + b"v," + b"9" * 10**5 + b",0,0\n",
        "a quote that never closes": header + b'"v' * 10**5,
        "not a number": header + b"v,nan,0,0\n",
        "infinity": header + b"v,0,-inf,0\n",
        "beyond any map": header + b"v,1e308,0,0\n",
        "BOM": b"\xef\xbb\xbf" + header + b"v,0,0,0\n",
        "UTF-16": (header + b"v,0,0,0\n").decode().encode("utf-16"),
        "columns twice": b"id,id,x_m,x_m,y_m,heading_rad\na,b,1,2,3,4\n",
        "ids twice": header + b"v,0,0,0\nv,0,0,0\n",
        "an id with lines": header + b'"v\n\x1b[31m",0,0,0\n',
        "entries with lines": b'0,"1\n\x1b"\n0,0\n',
        "too few fields": header + b"v\n",
        "too many fields": header + b"v,0,0,0,1,2,3\n",
        "NUL in a name": header + b"v\0,0,0,0\n",
        "old Macintosh": header.replace(b"\n", b"\r") + b"v,0,0,0\r",
    }


def _json() -> dict[str, bytes]:
    return {
        "arrays 10⁵ deep in JSON": b"[" * _DEEP,
        "objects 10⁵ deep in JSON": b'{"user":' * _DEEP,
        "5000 digits in JSON": b'{"user": ' + b"9" * 5000 + b', "password": ""}',
        "a user twice": b'{"user": "a", "user": "b", "password": ""}',
        "a user with lines": b'{"user": "a\\nb:c", "password": "d"}',
        "a password with lines": b'{"user": "a", "password": "b\\nroot:c"}',
        "a lone surrogate": b'{"user": "\\ud800", "password": "\\udfff"}',
        "a list": b"[1, 2]",
        "a word": b'"user password run processes passwords"',
        "nothing": b"null",
        "not a number in JSON": b'{"user": NaN, "password": Infinity}',
        "empty processes": b'{"run": "r", "processes": [[]], "passwords": {}}',
        "processes of numbers": b'{"run": "r", "processes": [[1]], "passwords": {}}',
        "passwords in a list": b'{"run": "r", "processes": [], "passwords": ["a"]}',
        "a run that is no name": b'{"run": "**", "processes": [["v"]], "passwords": {}}',
        "passwords with lines": b'{"run": "r", "processes": [], "passwords": {"a": "b\\nroot:c"}}',
        "a kind with lines": b'{"kind": "a\\nb' + b"c" * 10_000 + b'", "duration_s": 1}',
        "a fault of 4000 digits": b'{"kind": "kill", "duration_s": 1' + b"0" * 4000 + b"}",
        "a fault with an unknown key": b'{"kind": "kill", "duration_s": 1, "a\\nb": 1}',
        "a kind that is a list": b'{"kind": [[1]], "duration_s": 1}',
        "10⁵ nodes": b'{"kind": "kill", "duration_s": 1, "nodes": {"ids": [' + b'"v",' * 10**5 + b'"v"]}}',
        "certificates that are none": b'{"user": "a", "password": "b", "tls": {"ca": 3}}',
    }


def _xml() -> dict[str, bytes]:
    declared = b'<?xml version="1.0" encoding="%s"?>\n%s'
    roots = (b"net", b"osm", b"fcd-export", b"configuration")
    nasty = {f"XML in {of.decode()}": declared % (of, b"<net/>") for of in (b"klingon", b"shift_jis", b"base64")}
    entities = b'<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">' + b"".join(
        b'<!ENTITY %c "%s">' % (98 + i, b"&%c;" % (97 + i) * 10) for i in range(9)
    )
    nasty |= {f"entities in {root.decode()}": entities + b"]>\n<%s>&j;</%s>" % (root, root) for root in roots}
    nasty |= {f"{root.decode()} 10⁵ deep": b"<%s>" % root * _DEEP for root in roots}
    return nasty


NASTIES = {
    "empty": b"",
    "NUL": b"\0",
    "NULs": b"\0" * 100_000,
    "invalid UTF-8": b"\xff\xfe\x80" * 100,
    "BOM alone": b"\xef\xbb\xbf",
    "ones": b"\xff" * 100_000,
    **_msgpack(),
    **_toml(),
    **_csv(),
    **_json(),
    **_xml(),
}
