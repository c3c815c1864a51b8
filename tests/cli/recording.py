"""What a recording must hold, checked with h5py against the frames themselves."""
import xml.etree.ElementTree as ElementTree

import h5py
import numpy as np

from fake import unpack


def padded(array):
    """A field as FILE.h5 holds it: vectors with 3 components, tensors with 9."""
    if array.ndim == 2:
        out = np.zeros((len(array), 3), array.dtype)
        out[:, :array.shape[1]] = array
        return out
    if array.ndim == 3:
        out = np.zeros((len(array), 3, 3), array.dtype)
        out[:, :array.shape[1], :array.shape[2]] = array
        return out.reshape(len(array), 9)
    return array


def check_frames(path, frames, complete=True):
    """Every value of every frame, and that there are no others."""
    with h5py.File(path) as f:
        about = f["fbard"]
        assert bool(about.attrs["complete"]) == complete
        assert list(about["frames/seq"]) == list(range(len(frames)))
        for i, frame in enumerate(frames):
            header, arrays, digest = unpack(frame)
            for key in ("step", "time", "epoch", "count", "fbar"):
                assert about["frames/" + key][i] == header[key]
            assert about["frames/digest"][i] == digest
            row, n = about["frames/row"][i], header["count"]
            for name, array in arrays.items():
                kept = f["VTKHDF/Points" if name == "position" else "VTKHDF/PointData/" + name]
                assert kept.dtype == array.dtype
                np.testing.assert_array_equal(kept[row:row + n], padded(array))
        check_vtkhdf(f)


def check_vtkhdf(f):
    """The rules of "VTKHDF format specification", PolyData with Steps, version 2.0."""
    vtk, steps = f["VTKHDF"], f["VTKHDF/Steps"]
    assert list(vtk.attrs["Version"]) == [2, 0]
    assert vtk.attrs["Type"] == b"PolyData"
    assert not h5py.check_string_dtype(vtk.attrs.get_id("Type").dtype).length is None
    n = int(steps.attrs["NSteps"])
    parts = vtk["NumberOfPoints"][:]
    assert steps["Values"].shape == (n,) and len(parts) == n
    assert list(steps["PartOffsets"]) == list(range(n)) and list(steps["NumberOfParts"]) == [1] * n
    assert list(steps["PointOffsets"]) == list(np.cumsum([0, *parts])[:n])
    assert vtk["Points"].shape == (sum(parts), 3)
    for t, name in enumerate(("Vertices", "Lines", "Polygons", "Strips")):
        group = vtk[name]
        cells, ids = group["NumberOfCells"][:], group["NumberOfConnectivityIds"][:]
        assert len(cells) == n and len(ids) == n
        assert steps["CellOffsets"].shape == steps["ConnectivityIdOffsets"].shape == (n, 4)
        for i in range(n):  # as a reader does it: cells of the step, from its offsets on
            a, b = steps["CellOffsets"][i, t], steps["ConnectivityIdOffsets"][i, t]
            offsets = group["Offsets"][a:a + cells[i] + 1]
            connectivity = group["Connectivity"][b:b + ids[i]]
            assert len(offsets) == cells[i] + 1 and offsets[-1] == len(connectivity) == ids[i]
            if name == "Vertices":
                assert list(connectivity) == list(range(parts[i]))
                assert list(offsets) == list(range(parts[i] + 1))
            else:
                assert cells[i] == 0
    for name, array in vtk["PointData"].items():
        assert len(array) == sum(parts)
        assert list(steps["PointDataOffsets"][name]) == list(steps["PointOffsets"])
        assert "." not in name

    def has_units(name, thing):
        if isinstance(thing, h5py.Dataset):
            assert thing.attrs["unit"] and thing.attrs["long_name"], name
            assert not any(int(thing.id.get_create_plist().get_filter(i)[0]) > 2
                           for i in range(thing.id.get_create_plist().get_nfilters()))
    f.visititems(has_units)


def read_slab(folder, slab):
    """An item in the form for ParaView's XDMF reader of version 2, which must agree with the text that
    its reader of version 3 takes (client/xdmf.c)."""
    assert slab.get("ItemType") == "Hyperslab" and slab.get("Format") == "HDF"
    selection, source = slab.findall("DataItem")
    start, stride, count = np.array(selection.text.split(), int).reshape(3, -1)
    name, place = source.text.split(":")
    with h5py.File(folder / name) as f:
        data = f[place]
        assert list(data.shape) == [int(k) for k in source.get("Dimensions").split()]
        for item in (slab, source):
            assert data.dtype.itemsize == int(item.get("Precision"))
            assert item.get("NumberType") == {"f": "Float", "u": "UInt", "i": "Int"}[data.dtype.kind]
        assert (stride == 1).all()
        assert list(count) == [int(k) for k in slab.get("Dimensions").split()]
        text, parts = slab.text.split("|")
        assert text == source.text
        assert [[int(k) for k in part.split()] for part in parts.split(":")] == [
            list(start), list(stride), list(count), list(data.shape)]
        return data[tuple(slice(a, a + k) for a, k in zip(start, count))]


def read_xdmf(path):
    """[(time, {name: array})] as XDMF describes them, read with h5py as an XDMF reader would."""
    out = []
    for grid in ElementTree.parse(path).getroot().iter("Grid"):
        if grid.get("GridType") == "Collection":
            assert grid.get("CollectionType") == "Temporal"
            continue
        arrays = {item.get("Name") or "position": read_slab(path.parent, item.find("DataItem"))
                  for item in grid if item.tag in ("Geometry", "Attribute")}
        topology = grid.find("Topology")
        vertices = read_slab(path.parent, topology.find("DataItem"))
        assert list(vertices) == list(range(len(arrays["position"])))
        assert int(topology.get("NumberOfElements")) == len(vertices)
        out.append((float(grid.find("Time").get("Value")), arrays))
    return out
