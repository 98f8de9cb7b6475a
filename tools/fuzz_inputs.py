"""Damages valid inputs by seeded mutations of bytes, text, JSON, and formats with checksums or lengths."""

from __future__ import annotations

import io
import json
import re
import struct
import warnings
import zipfile
import zlib

import numpy as np

# Replacements for counts, sizes and offsets.
WHOLE = (
    0,
    1,
    2,
    3,
    127,
    255,
    256,
    65535,
    65536,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**40,
    2**62,
    2**63 - 1,
    2**64 - 1,
    -1,
    -(2**31),
    -(2**63),
)
REAL = (
    0.0,
    -0.0,
    1e-300,
    1e-38,
    5e-324,
    1e30,
    3.5e38,
    1e300,
    1e308,
    -1.0,
    -1e30,
    -1e300,
    float("nan"),
    float("inf"),
    float("-inf"),
)
WORDS = (
    *(
        "0",
        "-1",
        "1e400",
        "-1e400",
        "nan",
        "NaN",
        "inf",
        "-inf",
        "1e-400",
        "99999999999999999999",
        "18446744073709551616",
        "2147483648",
    ),
    *(
        "0x10",
        "1_000",
        "1,5",
        "1.5",
        "--",
        "",
        "\x00",
        "é",
        "\u2028",
        "٣",
        "𝟙",
        "\ufeff",
        "x" * 5000,
        "a/" * 3000,
        "../" * 40,
        "/dev/null",
    ),
    *(
        "/",
        ".",
        "..",
        "~",
        "con",
        "a\x00b",
        "%s%n",
        "{}",
        "'",
        '"',
        "\\",
        "#",
        "end_header",
        "element vertex 9",
        "format ascii 1.0",
    ),
)
VALUES = (
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        2**31,
        2**63,
        10**400,
        1e308,
        -1e308,
        1e-320,
        float("nan"),
        float("inf"),
        float("-inf"),
    ),
    *(
        "",
        "é\u2028",
        "\ud800",
        "a\x00b",
        "x" * 300,
        "x" * 5000,
        "a/" * 3000,
        "../" * 60,
        "/dev/null",
        "/",
        ".",
        "1",
        "OPENCV",
        "FISHEYE",
    ),
    *(
        [],
        {},
        [[]],
        [[1, 2], [3]],
        [1, "x", None],
        {"a": {}},
        [[1e308] * 4] * 4,
        [[0] * 4] * 4,
        [float("nan")] * 3,
        [1.5] * 3,
        [[[[[]]]]],
    ),
)


def mutate(rng: np.random.Generator, data: bytes, kind: str) -> bytes:
    """Apply one to three mutations to a file of a `kind`: ply, text, json, zip, npy, png, glb or binary."""
    aware = {"ply": _ply, "text": _text, "json": _json, "zip": _zip, "png": _png, "glb": _glb, "npy": _npy}.get(kind)
    for _ in range(int(rng.integers(1, 4))):
        data = aware(rng, data) if aware is not None and rng.random() < 0.65 else _bytes(rng, data)
    return data


def _pick(rng: np.random.Generator, values):
    return values[int(rng.integers(len(values)))]


def _span(rng: np.random.Generator, size: int) -> tuple[int, int]:
    """Return start and end of a random span within `size` bytes, mostly short."""
    start = int(rng.integers(0, size + 1))
    return start, min(size, start + int(2 ** rng.uniform(0, 10)))


def _number(rng: np.random.Generator) -> bytes:
    """Return the bytes of an unusual number, of random type and byte order."""
    order = _pick(rng, "<>")
    if rng.random() < 0.5:
        code = _pick(rng, "fd")
        value = _pick(rng, REAL)
        with np.errstate(over="ignore"):
            return np.array([value], np.dtype(code).newbyteorder(order)).tobytes()
    size = _pick(rng, (1, 2, 4, 8))
    return (int(_pick(rng, WHOLE)) % 256**size).to_bytes(size, "little" if order == "<" else "big")


def _bytes(rng: np.random.Generator, data: bytes) -> bytes:
    what = int(rng.integers(9))
    start, end = _span(rng, len(data))
    if what == 0:
        return data[:start]
    if what == 1 and data:
        flipped = bytearray(data)
        for place in rng.integers(0, len(data), int(2 ** rng.uniform(0, 5))):
            flipped[place] ^= 1 << int(rng.integers(8))
        return bytes(flipped)
    if what == 2:
        return data[:start] + rng.bytes(end - start) + data[end:]
    if what == 3:
        return data[:end] + data[start:end] * int(rng.integers(1, 4)) + data[end:]
    if what == 4:
        return data[:start] + data[end:]
    if what == 5:
        other, stop = _span(rng, len(data))
        return data[:start] + data[other:stop] + data[end:]
    if what == 6:
        return data + rng.bytes(int(2 ** rng.uniform(0, 8)))
    # Half of the numbers are placed at the front, where headers are.
    place = int(rng.integers(0, min(len(data), 256) + 1)) if rng.random() < 0.5 else start
    number = _number(rng)
    return data[:place] + number + data[place + len(number) :]


def _text(rng: np.random.Generator, data: bytes) -> bytes:
    lines = data.decode("latin-1").split("\n")
    row, other = int(rng.integers(len(lines))), int(rng.integers(len(lines)))
    what = int(rng.integers(6))
    if what == 0:
        lines[row : row + int(rng.integers(1, 4))] = []
    elif what == 1:
        lines[row:row] = [lines[other]] * int(rng.integers(1, 4))
    elif what == 2:
        lines[row], lines[other] = lines[other], lines[row]
    else:
        words = re.split(r"(\s+)", lines[row])
        place = int(rng.integers(len(words)))
        if what == 3:
            words[place] = _pick(rng, words)
        elif what == 4:
            words[place : place + 1] = []
        else:
            words[place] = _pick(rng, WORDS) if rng.random() < 0.8 else repr(_pick(rng, (*WHOLE, *REAL)))
        lines[row] = "".join(words)
    return "\n".join(lines).encode("utf-8", "replace")


def _ply(rng: np.random.Generator, data: bytes) -> bytes:
    """Mutate the header as text; the rest stays unchanged."""
    end = data.find(b"end_header\n")
    if end < 0:
        return _bytes(rng, data)
    end += len(b"end_header\n")
    return _text(rng, data[:end]) + data[end:]


def _json(rng: np.random.Generator, data: bytes) -> bytes:
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return _text(rng, data)
    if rng.random() < 0.02:
        return b"[" * 100_000 if rng.random() < 0.5 else json.dumps(_pick(rng, VALUES)).encode()
    _change(rng, value)
    return json.dumps(value).encode()


def _change(rng: np.random.Generator, value) -> None:
    """Change one entry somewhere in a nested list or dict."""
    while isinstance(value, (dict, list)) and value:
        key = _pick(rng, list(value)) if isinstance(value, dict) else int(rng.integers(len(value)))
        if isinstance(value[key], (dict, list)) and value[key] and rng.random() < 0.8:
            value = value[key]
            continue
        what = rng.random()
        if what < 0.7:
            value[key] = _pick(rng, VALUES)
        elif what < 0.85:
            del value[key]
        elif isinstance(value, list):
            value.extend([value[key]] * int(rng.integers(1, 5)))
        else:
            value[_pick(rng, list(value))] = value[key]
        return


def _zip(rng: np.random.Generator, data: bytes) -> bytes:
    """Change, remove, duplicate or rename members, with valid checksums. Arrays are mutated as arrays, other members as
    bytes."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    except Exception:  # noqa: BLE001 - broken by an earlier mutation
        return _bytes(rng, data)
    if not members:
        return data
    place, what = int(rng.integers(len(members))), rng.random()
    name, content = members[place]
    method, enormous = zipfile.ZIP_STORED, -1
    if what < 0.1:
        del members[place]
    elif what < 0.15:
        members.append((name, content))
    elif what < 0.2:
        members[place] = (_pick(rng, WORDS)[:1000].replace("\x00", "") or "x", content)
    elif what < 0.3:
        members[place] = (name, _pick(rng, members)[1])
    elif what < 0.35:
        members[place] = (name, content + bytes(int(2 ** rng.uniform(0, 24))))
        method = zipfile.ZIP_DEFLATED
    elif what < 0.36 and content.startswith(b"\x93NUMPY"):
        members[place] = (name, _enormous_header(rng))
        method, enormous = zipfile.ZIP_DEFLATED, place
    elif what < 0.75 and content.startswith(b"\x93NUMPY"):
        members[place] = (name, _npy(rng, content))
    else:
        members[place] = (name, _bytes(rng, content))
    out = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w", method) as archive:
        warnings.simplefilter("ignore")
        for number, (name, content) in enumerate(members):
            with archive.open(name, "w") as file:
                file.write(content)
                for _ in range(256 if number == enormous else 0):
                    file.write(bytes(2**20))
    return out.getvalue()


def _enormous_header(rng: np.random.Generator) -> bytes:
    """Return the start of a .npy file of 256 MiB, in an array or in the header itself."""
    if rng.random() < 0.2:
        return b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**28)
    shape = _pick(rng, ((2**26,), (2**24, 4), (2**13, 2**13), (2**24, 4, 1)))
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00\x76\x00" + header


def _npy(rng: np.random.Generator, content: bytes) -> bytes:
    """Return an array with another type, shape or values, or with a header that declares these without changing the
    data."""
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
        array = array if array.dtype.kind in "fiub" else array.astype("<U30")
    except Exception:  # noqa: BLE001 - broken by an earlier mutation
        return _bytes(rng, content)
    what = int(rng.integers(5))
    if what == 0:
        shape = tuple(int(x) for x in rng.choice([0, 1, 2, 3, 4, 7, 10**6, 2**31, 2**62, -1], rng.integers(0, 5)))
        kind = _pick(rng, ("<f4", ">f8", "|O", "<U9", "|V3", "<i8", "<c16"))
        header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
        length = struct.unpack_from("<H", content, 8)[0]
        return content[:10] + header.encode().ljust(length - 1)[: length - 1] + b"\n" + content[10 + length :]
    with np.errstate(all="ignore"):
        if what == 1:
            numbers = ("<f8", ">f4", "<i4", "|b1", "<c16", "<f2", "<U5", "|S3")
            array = np.array(array).astype(
                _pick(rng, numbers if array.dtype.kind in "fiub" else ("<U5", "<U30", ">U24"))
            )
        elif what == 2 and array.size:
            flat = np.array(array).ravel()
            if flat.dtype.kind in "fiu":
                value = _pick(rng, REAL if flat.dtype.kind == "f" else (0, 1, 100))
                flat[int(rng.integers(flat.size))] = value
            array = flat.reshape(array.shape)
        elif what == 3:
            array = array[..., None] if rng.random() < 0.5 else array.reshape(-1)
        else:
            array = array[: int(rng.integers(0, len(array) + 1))] if array.ndim else np.array([array])
    out = io.BytesIO()
    np.save(out, array, allow_pickle=False)
    return out.getvalue()


def _png(rng: np.random.Generator, data: bytes) -> bytes:
    """Remove, duplicate, rename or change chunks, with valid checksums, or declare a size that differs from the
    pixels."""
    chunks, place = [], 8
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        chunks.append((data[place + 4 : place + 8], data[place + 8 : place + 8 + length]))
        place += 12 + length
    if not chunks:
        return _bytes(rng, data)
    row, what = int(rng.integers(len(chunks))), int(rng.integers(6))
    name, content = chunks[row]
    if what == 0:
        del chunks[row]
    elif what == 1:
        chunks.insert(row, _pick(rng, chunks))
    elif what == 2:
        content = _bytes(rng, content)
        chunks[row] = (name, content)
    elif what == 3 and chunks[0][0] == b"IHDR" and len(chunks[0][1]) == 13:
        sizes = [int(_pick(rng, (0, 1, 9, 12, 4000, 13000, 30000, 65535, 2**31 - 1, 2**32 - 1))) for _ in range(2)]
        chunks[0] = (b"IHDR", struct.pack(">II", *sizes) + chunks[0][1][8:])
    elif what == 4:
        text = zlib.compress(bytes(int(2 ** rng.uniform(8, 24))))
        chunks.insert(1, _pick(rng, ((b"zTXt", b"a\0\0" + text), (b"iCCP", b"a\0\0" + text), (b"eXIf", rng.bytes(60)))))
    else:
        name = bytes(b ^ (32 if rng.random() < 0.2 else 0) for b in name)
        chunks[row] = (name, content)
    out = [data[:8]]
    for name, content in chunks:
        out += [struct.pack(">I", len(content)), name, content, struct.pack(">I", zlib.crc32(name + content))]
    return b"".join(out)


def _glb(rng: np.random.Generator, data: bytes) -> bytes:
    """Mutate the JSON chunk, with matching lengths."""
    if len(data) < 20 or data[:4] != b"glTF":
        return _bytes(rng, data)
    (length,) = struct.unpack_from("<I", data, 12)
    text = _json(rng, data[20 : 20 + length])
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return data[:8] + struct.pack("<II", 20 + len(text) + len(rest), len(text)) + data[16:20] + text + rest
