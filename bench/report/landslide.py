"""Landslide: figures 14 to 16 of the paper."""
from cases import grid

TITLE = "Landslide"


def cases(size):
    made = grid("slice", "landslide-slice", {}, 25)
    if size == "paper":
        order = {("gimp", "zhao"): 5, ("bspline2", "zhao"): 50, ("bspline2", "standard"): 60,
                 ("gimp", "standard"): 61, ("gimp", "anchored"): 90, ("bspline2", "anchored"): 91}  # fmt: skip
        made += grid("landslide", "landslide", {}, lambda b, s: order[b, s])
    return made


def sections(shelf):
    return []
