"""ND2 files of version 3.0, written chunk by chunk; the metadata are XML, as the version before has them."""

import struct
import zlib

_MAP, _END = b"ND2 FILEMAP SIGNATURE NAME 0001!", b"ND2 CHUNK MAP SIGNATURE 0000001!"


def _variant(**values):
    lines = (
        f'<{name} runtype="{"CLxStringW" if isinstance(value, str) else "lx_uint32"}" value="{value}"/>'
        for name, value in values.items()
    )
    return f'<variant version="1.0"><no_name>{"".join(lines)}</no_name></variant>'.encode()


def nd2_bytes(stack, *, bits=12, channels=1, words="", compressed=False):
    """Return a file of frames (frame, y, x), or (frame, y, x, channel)."""
    n, rows, columns = stack.shape[:3]
    data, places = bytearray(), {}

    def chunk(name, content, reserve=0):
        places[name] = len(data), len(content)
        data.extend(struct.pack("<IIQ", 0x0ABECEDA, max(len(name), reserve), len(content)))
        data.extend(name.ljust(reserve, b"\0") + content)

    chunk(b"ND2 FILE SIGNATURE CHUNK NAME01!", b"Ver3.0".ljust(64, b"\0"))
    places.clear()
    size = {"uiWidth": columns, "uiHeight": rows, "uiWidthBytes": columns * channels * stack.itemsize}
    depth = {"uiBpcInMemory": 8 * stack.itemsize, "uiBpcSignificant": bits, "uiComp": channels}
    kind = {"uiSequenceCount": n, "eCompression": 0 if compressed else 2}
    chunk(b"ImageAttributesLV!", _variant(**size, **depth, **kind))
    chunk(b"ImageMetadataSeqLV|0!", _variant(uiCount=1))
    chunk(b"ImageTextInfoLV!", _variant(TextInfoItem_6=words))
    for t, frame in enumerate(stack):
        content = zlib.compress(frame.tobytes()) if compressed else frame.tobytes()
        chunk(b"ImageDataSeq|%d!" % t, struct.pack("<d", t) + content, 4072)
    start = len(data)
    listed = b"".join(name + struct.pack("<QQ", *place) for name, place in places.items())
    chunk(_MAP, listed + _END + struct.pack("<Q", start))
    return bytes(data)
