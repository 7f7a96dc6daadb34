"""SPE files, written after the maker's description."""

import struct

_KINDS = {"<f4": 0, "<i4": 1, "<i2": 2, "<u2": 3, "|u1": 6, "<u4": 8}

_FOOTER = """<?xml version="1.0" encoding="utf-8"?>
<SpeFormat version="3.0" xmlns="http://www.princetoninstruments.com/spe/2009"><DataFormat>
<DataBlock type="Frame" count="{n}" size="{size}" stride="{stride}" metaFormat="1">
{regions}</DataBlock></DataFormat><MetaFormat><MetaBlock id="1">
<TimeStamp event="ExposureStarted" type="Int64" bitDepth="64" resolution="1000000"
 absoluteTime="2026-01-31T12:00:00.5000000+01:00" />
<TimeStamp event="ExposureEnded" type="Int64" bitDepth="64" resolution="1000000"
 absoluteTime="2026-01-31T12:00:00.5000000+01:00" />
<FrameTrackingNumber type="Int64" bitDepth="64" /></MetaBlock></MetaFormat>
<DataHistories><DataHistory><Origin created="2026-01-31T12:00:09.0000000+01:00">
<Experiment xmlns="http://www.princetoninstruments.com/experiment/2009"><Devices><Cameras>
<Camera model="BLAZE" serialNumber="0705">
<ShutterTiming><ExposureTime type="Double">250</ExposureTime></ShutterTiming>
<Sensor><Temperature><Reading>-95</Reading></Temperature></Sensor>
<Adc><AnalogGain>High</AnalogGain><BitDepth>{depth}</BitDepth></Adc>
</Camera></Cameras></Devices></Experiment></Origin></DataHistory></DataHistories></SpeFormat>
"""


def spe_bytes(stack, *, version=2.2, regions=1, numbers=None):
    """Return a file of version 2, or of version 3 with numbers (begin, end, count) behind each frame."""
    n, rows, columns = stack.shape
    head = bytearray(4100)
    fields = [("<f", 10, 0.5), ("<f", 36, -70.0), ("<H", 42, columns), ("<h", 108, _KINDS[stack.dtype.str])]
    fields += [("<H", 656, rows), ("<i", 1446, n), ("<h", 1510, regions), ("<f", 1992, version)]
    frames = [frame.tobytes() for frame in stack]
    footer = b""
    if version >= 3:
        frames = [frame + struct.pack("<3q", *each) for frame, each in zip(frames, numbers, strict=True)]
        region = f'<DataBlock type="Region" count="1" width="{columns}" height="{rows}" />'
        sizes = {"size": stack[0].nbytes, "stride": stack[0].nbytes + 24, "depth": 8 * stack.itemsize}
        footer = _FOOTER.format(n=n, regions=regions * region, **sizes).encode()
        fields.append(("<Q", 678, len(head) + sum(map(len, frames))))
    for kind, place, value in fields:
        struct.pack_into(kind, head, place, value)
    return bytes(head) + b"".join(frames) + footer


def write_spe(path, stack, version=2.2):
    frames = stack.reshape(-1, *stack.shape[-2:])
    stored = frames.astype(frames.dtype.newbyteorder("<"))
    numbers = [(1_000_000 * t, 1_000_000 * t + 1000, t + 1) for t in range(len(frames))]
    path.write_bytes(spe_bytes(stored, version=version, numbers=numbers))
