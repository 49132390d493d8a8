"""Random changes to small valid files, as damaged disks, editors and other programs make them."""

from hypothesis import strategies as st

TOKENS = (
    b"", b"\x00", b"\xff\xfe", b"nan", b"-inf", b"1e999", b"-1", b"0", b"999999999999", b"null",
    b"{}", b"[]", b'"', b"\n", b": ", b"\xc3\xa9", b"../", b"/dev/null", b"A" * 300, b"true",
)  # fmt: skip


@st.composite
def mutated(draw: st.DrawFn, data: bytes) -> bytes:
    """`data` after one to four changes: cut, bytes changed, taken out, doubled or put in."""
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        length = draw(st.integers(0, min(64, len(data) - start)))
        kind = draw(st.sampled_from(("cut", "change", "remove", "double", "insert", "replace")))
        middle = data[start : start + length]
        if kind == "cut":
            data = data[:start]
            continue
        if kind == "change":
            key = draw(st.integers(1, 255))
            middle = bytes(byte ^ key for byte in middle)
        elif kind == "remove":
            middle = b""
        elif kind == "double":
            middle = 2 * middle
        else:
            token = draw(st.sampled_from(TOKENS))
            middle = middle + token if kind == "insert" else token
        data = data[:start] + middle + data[start + length :]
    return data
