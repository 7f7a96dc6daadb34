"""SIF files, written line by line as Andor Solis does (version 65559)."""

MAGIC = b"Andor Technology Multi-Channel File\n"


def sif_bytes(stack, *, sums=1, step=500_000, tracks=1):
    n, rows, columns = stack.shape
    third = f"65559 0 0 1 1700000000 -80 {'':10} 0 0.25 0.5 0.25 {sums} \0 0.5 1e-08 0 1 300 0 0 1e-09"
    lines = [
        "65538 1",
        f"{third} {'0 ' * 16}0 0",
        "DU-897_BV",
        f"{columns} {rows} 5",
        "a.sif \n65538 4",  # the name has as many bytes as the line before says
        "note\n65538 \1 \2 \3 \4 0 0",
        *8 * ["0"],
        "0 none",
        "65539 \1 \0 \1 \0",
        "0 1 0 0",
        "0 1 0 0",
        "0",
        "422",
        "13",
        "13",
        "12",
        "Pixel number6\nCounts12",
        f"Pixel number65541 1 {rows} {columns} 1 {n} {tracks} {stack.size} {stack[0].size}",
        *tracks * [f"65538 1 {rows} {columns} 1 1 1 0"],
        *[str(step * t) for t in range(n)],
        "0",
    ]
    return MAGIC + ("\n".join(lines) + "\n").encode() + tracks * stack.astype("<f4").tobytes()
