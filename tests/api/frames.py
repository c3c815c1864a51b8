"""Decodes a frame from the contract's section 4 alone: a JSON parser, offsets and numpy."""
import ctypes
import ctypes.util
import struct

import numpy as np

from fbard import strict_json


def _digest():
    name = ctypes.util.find_library("xxhash")
    if name is None:
        return None
    function = ctypes.CDLL(name).XXH3_64bits
    function.restype, function.argtypes = ctypes.c_uint64, [ctypes.c_char_p, ctypes.c_size_t]
    return lambda text: function(text, len(text))


digest = _digest()  # None where the library has no run-time part


class Frame:
    """`header` as a dict, and the arrays by name in `fields`."""

    def __init__(self, block):
        magic, n_header, flags, total, xxh3 = struct.unpack_from("<8sIIQQ", block)
        assert magic == b"FBARFRM1"
        assert total == len(block)
        assert block[32:64] == bytes(32)
        assert flags == 0, "no flag is defined"
        assert n_header % 64 == 0
        if digest:
            assert xxh3 == digest(block[64:])
        self.block = block
        self.header = strict_json(block[64 : 64 + n_header].decode("utf-8"))
        self.fields, self.units = {}, {}
        end = 64 + n_header
        for field in sorted(self.header["fields"], key=lambda f: f["offset"]):
            assert field["offset"] % 64 == 0
            assert field["offset"] >= end, "arrays overlap"
            kind, shape = np.dtype(field["dtype"]), tuple(field["shape"])
            assert field["bytes"] == kind.itemsize * int(np.prod(shape))
            assert shape[0] == self.header["count"]
            assert field["name"] not in self.fields
            end = field["offset"] + field["bytes"]
            self.fields[field["name"]] = np.frombuffer(
                block, kind, int(np.prod(shape)), field["offset"]
            ).reshape(shape)
            self.units[field["name"]] = field["unit"]
        assert end <= len(block) < end + 64

    def __getitem__(self, name):
        return self.fields[name]


def picked(cut, whole, stride):
    """The rows of `whole` that `cut` has: one of every `stride`, the same for all fields."""
    assert cut.header["count"] == -(-whole.header["count"] // stride)
    rows = []
    for g in range(cut.header["count"]):
        group = slice(g * stride, (g + 1) * stride)
        same = np.all([np.all(whole[name][group].reshape(len(whole[name][group]), -1) == cut[name][g].ravel(), axis=1)
                       for name in cut.fields], axis=0)  # fmt: skip
        assert same.any(), g
        rows.append(g * stride + int(np.argmax(same)))
    return rows
