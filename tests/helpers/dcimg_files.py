"""DCIMG files, written by the layout that public readers of the format agree on."""

import numpy as np

MARKER = np.array([0, 65535, 0, 65535], "<u2").view("u1")
SESSION = 112


def put(content, offset, kind, *values):
    data = np.array(values, kind).tobytes()
    content[offset : offset + len(data)] = data


def write_dcimg(
    path, stack, *, version=0x1000000, row=3, footer=32, stamps=None, more=0, sessions=1, depth=None
):
    """Write frames of 8 or 16 bits.

    Args:
        path: the file.
        stack: frames, (n, rows, columns).
        version: of the format: 7, or 0x1000000 and more.
        row: whose first 8 bytes are stored apart; None: none.
        footer: bytes behind each frame of the newer versions.
        stamps: number of each frame; None: counted from 1.
        more: additional columns, behind the others.
        sessions: stated number of sessions.
        depth: stated bytes of a sample; None: those of the stack.
    """
    n, rows, columns = stack.shape
    size = stack.dtype.itemsize
    stamps = 1 + np.arange(n) if stamps is None else np.asarray(stamps)
    times = [(1_700_000_000 + t // 20, 50_000 * (t % 20)) for t in range(n)]
    wide = np.zeros((n, rows, columns + more), stack.dtype.newbyteorder("<"))
    wide[:, :, :columns] = stack
    frames = wide.view("u1").reshape(n, rows, -1)
    apart = np.zeros((n, 8), "u1")
    if row is not None:
        apart[:] = frames[:, row, :8]
        frames[:, row, :8] = MARKER
    row_bytes = frames.shape[2]
    content = bytearray(SESSION)
    content[:5] = b"DCIMG"
    put(content, 8, "<u4", version)
    put(content, 32, "<u4", sessions, n, SESSION)
    if version == 7:
        head = bytearray(120)
        put(head, 32, "<u4", n, depth or size, 0, columns, row_bytes, rows, row_bytes * rows)
        put(head, 68, "<u4", len(head))
        put(head, 72, "<u8", len(head) + frames.size)
        tail = bytearray(272)
        put(tail, 0, "<u4", 7)
        put(tail, 8, "<u8", 160)
        put(tail, 40, "<u4", 272 + (12 + 8 * (row is not None)) * n)
        put(tail, 160 + 88, "<u8", 272 + 12 * n)
        put(tail, 160 + 100, "<u4", row_bytes * (row or 0))
        put(tail, 160 + 104, "<u8", 8 * (row is not None))
        tail += stamps.astype("<u4").tobytes() + np.array(times, "<u4").tobytes()
        if row is not None:
            tail += apart.tobytes()
        path.write_bytes(bytes(content) + bytes(head) + frames.tobytes() + bytes(tail))
        return
    head = bytearray(752)
    put(head, 60, "<u4", n, depth or size, 0, columns, rows, row_bytes, row_bytes * rows)
    put(head, 96, "<u8", len(head))
    put(head, 116, "<u4", row_bytes * rows + footer, 0, footer)
    # region of the sensor: whole rows, so that the readers which reckon come to the marked one
    put(head, 712, "<u2", 0, columns, 1023 - (row or 0), rows)
    parts = []
    for t in range(n):
        tail = bytearray(footer)
        put(tail, 0, "<u4", stamps[t], *times[t])
        if footer >= 32:
            put(tail, 12, "u1", *apart[t])
        parts += [frames[t].tobytes(), bytes(tail[:footer])]
    path.write_bytes(bytes(content) + bytes(head) + b"".join(parts))
