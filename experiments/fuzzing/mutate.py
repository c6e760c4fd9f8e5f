"""Damage to valid files: cuts, flips, numbers that are none, wrong encodings, archives that want to fill the memory."""

import gzip
import io
import random
import re
import zipfile
from collections.abc import Callable

#: What is written into files: numbers at the edge, words that readers give a meaning, bytes that are no text.
TOKENS = (
    b"nan", b"NaN", b"inf", b"-inf", b"1e999", b"-1e999", b"1e-999", b"-0.0", b"0", b"1", b"-1", b"4e-324",
    b"99999999999999999999", b"9223372036854775808", b"-9223372036854775809", b"1_0", b"0x10", b"1.5e18", b"true",
    b"null", b"None", b"''", b'""', b"#", b",", b", ", b";", b" ", b"\t", b"\n", b"\r", b"\r\n", b"\n\n", b"\x00",
    b"\xff", b"\xfe\xff", b"\xff\xfe", b"\xef\xbb\xbf", b"\xed\xa0\x80", b"\x1f\x8b", b"PK\x03\x04", b"\x93NUMPY", b":",
    b": ", b"- ", b"&a ", b"*a", b"<<: ", b"!!python/object:os.system ", b"!!binary ", b"!!timestamp ", b"2001-99-99",
    b"{", b"}", b"[", b"]", b"[[", b"%YAML:1.0\n", b"---\n", b"...\n", b"|", b">", b"\\", b"\\u0000", b"\xc2\xa0",
    b"cam0", b"imu0", b"ROOT", b"JOINT", b"CHANNELS", b"End Site", b"MOTION", b"Frames:", b"9" * 5000, b"1e400000000",
    b"R1000000000", b"R3x" * 500, b"\xf0\x9f\x9a\x80",
    b"<", b"</", b"/>", b"<!--", b"&x;", b"&#0;",
    b"<!DOCTYPE a [<!ENTITY x SYSTEM '/dev/zero'>]>", b"<include file='/dev/zero'/>", b"<body>", b"<joint/>",
    b"\x00" * 16, b"\xff" * 16, b"\x7f\xff\xff\xff",
)  # fmt: skip
_NUMBER = re.compile(rb"[-+]?[0-9]+\.?[0-9]*(?:[eE][-+]?[0-9]+)?")
#: Sizes of what bombs unpack to, bytes: more than a reader may use.
_BOMB = 5 * 2**28
_CHUNK = bytes(2**22)

Random = random.Random


def _span(data: bytes, rng: Random, longest: int = 64) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.randrange(1, longest + 1))


def flip(data: bytes, rng: Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 5, 20))):
        if changed:
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def overwrite(data: bytes, rng: Random) -> bytes:
    start, end = _span(data, rng, 16)
    return data[:start] + rng.randbytes(end - start) + data[end:]


def insert(data: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(TOKENS) + data[at:]


def replace_number(data: bytes, rng: Random) -> bytes:
    found = list(_NUMBER.finditer(data))
    if not found:
        return insert(data, rng)
    start, end = rng.choice(found).span()
    return data[:start] + rng.choice(TOKENS) + data[end:]


def delete(data: bytes, rng: Random) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def truncate(data: bytes, rng: Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def repeat_span(data: bytes, rng: Random) -> bytes:
    start, end = _span(data, rng)
    return data[:end] + data[start:end] * rng.choice((1, 2, 100)) + data[end:]


def swap_lines(data: bytes, rng: Random) -> bytes:
    lines = data.splitlines(keepends=True)
    if len(lines) > 1:
        i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
        lines[i], lines[j] = lines[j], lines[i]
    return b"".join(lines)


def drop_line(data: bytes, rng: Random) -> bytes:
    lines = data.splitlines(keepends=True)
    if lines:
        del lines[rng.randrange(len(lines))]
    return b"".join(lines)


def drop_column(data: bytes, rng: Random) -> bytes:
    separator = rng.choice((b" ", b","))
    column = rng.randrange(8)
    rows = [line.split(separator) for line in data.split(b"\n")]
    return b"\n".join(separator.join(row[:column] + row[column + 1 :]) for row in rows)


def recode(data: bytes, rng: Random) -> bytes:
    return data.decode("latin-1").encode(rng.choice(("utf-16", "utf-16-be", "utf-32", "utf-7", "cp500")))


def whole(data: bytes, rng: Random) -> bytes:
    """Something else altogether."""
    return rng.choice(
        (
            b"",
            rng.randbytes(rng.randrange(1, 2000)),
            rng.choice(TOKENS) * rng.randrange(1, 300),
            b"[" * 20_000,
            b"{a: " * 3_000,
            b"1," * 20_000,
            b"1 2 3 4 5 6 7 8\n" * 1_000,
            data * rng.randrange(2, 20),
            aliases(rng),
            entities(data, rng),
            nested(rng),
        )
    )


def aliases(rng: Random) -> bytes:
    """A YAML file of a few lines whose text, written out, would have 9^20 words."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 20)]
    name = rng.choice(("update_rate", "gyroscope_noise_density", "T_BS", "cam0", "imu0", "gyroscopes"))
    return "\n".join([*lines, f"{name}: *a19", ""]).encode()


def entities(data: bytes, rng: Random) -> bytes:
    """An XML file of a few lines whose text, written out, has 10^9 characters; alone, or in what was valid."""
    lines = ["<!DOCTYPE root [", ' <!ENTITY a0 "xxxxxxxxxx">']
    lines += [f' <!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 9)]
    content = rng.choice(
        ("<root>&a8;</root>", '<mujoco model="&a8;"/>', "<robot name='&a8;'><link name='x'/></robot>")
    )
    inside = data.replace(b'"', b'"&a8;', 1).partition(b"?>")[2] or data
    return "\n".join([*lines, "]>", ""]).encode() + rng.choice((content.encode(), inside))


def nested(rng: Random) -> bytes:
    """XML that goes deep."""
    name, depth = (
        rng.choice(("body", "default", "replicate", "frame", "a")),
        rng.choice((100, 3_000, 100_000)),
    )
    inner = rng.choice(("", "".join(f"</{name}>" for _ in range(depth))))
    outer = rng.choice(("", "<mujoco><worldbody>"))
    return f"{outer}{f'<{name}>' * depth}{inner}{'</worldbody></mujoco>' if outer else ''}".encode()


SIMPLE: tuple[Callable[[bytes, Random], bytes], ...] = (
    flip, overwrite, insert, insert, replace_number, replace_number, replace_number, delete, truncate, repeat_span,
    swap_lines, drop_line, drop_column, recode, whole,
)  # fmt: skip


def mutate(data: bytes, rng: Random) -> bytes:
    """One to four kinds of damage, to the file or to what is packed in it; rarely a bomb."""
    choice = rng.random()
    if choice < 0.003:
        return rng.choice((gzip_bomb, zip_bomb, lambda: text_bomb(data)))()
    if data.startswith(b"PK") and choice < 0.6:
        return _inside_zip(data, rng)
    if data.startswith(b"\x1f\x8b") and choice < 0.6:
        return gzip.compress(_damaged(gzip.decompress(data), rng), 1, mtime=0)
    damaged = _damaged(data, rng)
    return gzip.compress(damaged, 1, mtime=0) if choice > 0.97 else damaged


def _damaged(data: bytes, rng: Random) -> bytes:
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(SIMPLE)(data, rng)
    return data


def _inside_zip(data: bytes, rng: Random) -> bytes:
    """The same archive, checksums right, with damage to one of its members, to its name, or without it."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    i = rng.randrange(len(members))
    name, content = members[i]
    # Headers are where readers believe things.
    head = rng.choice((min(len(content), 128), len(content)))
    members[i] = name, _damaged(content[:head], rng) + content[head:]
    if rng.random() < 0.1:
        members[i] = rng.choice((f"../{name}", "x.npy", name.upper(), f"{name}/")), members[i][1]
    elif rng.random() < 0.1:
        del members[i]
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, content in members:
            info = zipfile.ZipInfo(name)  # with a date that is always the same
            info.compress_type = archive.compression
            archive.writestr(info, content)
    return packed.getvalue()


_bombs: dict[str, bytes] = {}


def prepare() -> None:
    """Makes the bombs: processes that are forked later need not."""
    gzip_bomb()
    zip_bomb()


def gzip_bomb() -> bytes:
    """Some megabytes that unpack to more than a gigabyte of zeros."""
    if "gzip" not in _bombs:
        packed = io.BytesIO()
        with gzip.GzipFile(fileobj=packed, mode="wb", compresslevel=1, mtime=0) as stream:
            for _ in range(_BOMB // len(_CHUNK)):
                stream.write(_CHUNK)
        _bombs["gzip"] = packed.getvalue()
    return _bombs["gzip"]


def text_bomb(data: bytes) -> bytes:
    """A megabyte that unpacks to a valid file whose last line comes until it has a quarter of a gigabyte."""
    text = gzip.decompress(data) if data.startswith(b"\x1f\x8b") else data
    key = f"text {hash(text)}"
    if key not in _bombs:
        last = text.rstrip().rpartition(b"\n")[2] + b"\n"
        chunk = last * (len(_CHUNK) // len(last) + 1)
        packed = io.BytesIO()
        with gzip.GzipFile(fileobj=packed, mode="wb", compresslevel=1, mtime=0) as stream:
            stream.write(text.rstrip() + b"\n")
            for _ in range(_BOMB // 5 // len(chunk)):
                stream.write(chunk)
        _bombs[key] = packed.getvalue()
    return _bombs[key]


def zip_bomb() -> bytes:
    """An npz archive whose arrays unpack to more than a gigabyte."""
    if "zip" not in _bombs:
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name in ("header.npy", "t_ns.npy"):
                with archive.open(name, "w", force_zip64=True) as stream:
                    for _ in range(_BOMB // 2 // len(_CHUNK)):
                        stream.write(_CHUNK)
        _bombs["zip"] = packed.getvalue()
    return _bombs["zip"]
