"""Compiled loops of `CellMap`.

Masks stay uint64 throughout, because numba turns a sum of uint64 and int64 into a float; indices are unsigned where it
matters, because for signed ones it checks for negative values, which count from the end.
"""

from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from asca_pillars.base.compiling import compiled, in_array, inner, out_array

_Integers = NDArray[np.int64]
_Rows = NDArray[np.int32]
_Masks = NDArray[np.uint64]

_ONE = np.uint64(1)
_CELLS, _COLUMNS = in_array(types.int64), (in_array(types.uint64), in_array(types.int32))
_LINKS = (in_array(types.int64, 2),) * 3


@inner
def bits_set(mask: np.uint64) -> Any:
    """Return the number of set bits."""
    mask = mask - ((mask >> np.uint64(1)) & np.uint64(0x5555555555555555))
    mask = (mask & np.uint64(0x3333333333333333)) + ((mask >> np.uint64(2)) & np.uint64(0x3333333333333333))
    mask = (mask + (mask >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((mask * np.uint64(0x0101010101010101)) >> np.uint64(56))


@inner
def bits_of(mask: _Masks, start: _Rows, column: np.uint64) -> Any:
    """Return the active cells of a column; on a lattice one cell high, which has no masks, the lowest bit alone."""
    return mask[column] if len(mask) else np.uint64(start[column] >= 0)


@compiled(_CELLS, types.int64, out_array(types.uint64), out_array(types.int32))
def clear_columns(cells: _Integers, nz: int, mask: _Masks, start: _Rows) -> None:
    """Empty the columns (ny * nx,) of these cells, flat indices (N,)."""
    if nz == 1:
        start[:] = -1
        return
    for i in range(len(cells)):
        mask[np.uint64(cells[i]) // np.uint64(nz)] = 0


@compiled(_CELLS, types.int64, out_array(types.uint64), out_array(types.int32))
def enter_cells(cells: _Integers, nz: int, mask: _Masks, start: _Rows) -> None:
    """Enter ascending cells, flat indices (N,), into empty columns (ny * nx,)."""
    if nz == 1:
        for i in range(len(cells)):
            start[np.uint64(cells[i])] = i
        return
    for i in range(len(cells)):
        column = np.uint64(cells[i]) // np.uint64(nz)
        if mask[column] == 0:
            start[column] = i
        mask[column] |= _ONE << (np.uint64(cells[i]) - column * np.uint64(nz))


@inner
def _mark(mask: _Masks, start: _Rows, column: np.uint64, bits: np.uint64) -> Any:
    """Set these bits of a column, and return how many were not set before."""
    new = bits & ~bits_of(mask, start, column)
    if new and len(mask):
        mask[column] |= new
    elif new:
        start[column] = 0
    return bits_set(new)


@inner
def _mark_flat(cells: _Integers, y_links: _Integers, x_links: _Integers, taps: int, nx: int, start: _Rows) -> Any:
    """Compute `mark_joined` where both lattices are one cell high and the kernel is square, several times as fast."""
    nowhere, width = np.uint64(len(start) - 1), len(x_links)
    row, marked = 0, np.int64(0)
    start[nowhere] = 0
    for i in range(len(cells)):
        while cells[i] >= (row + 1) * width:
            row += 1
        x_of = x_links[np.uint64(cells[i] - row * width)]
        for ky in range(taps):
            y = y_links[np.uint64(row), np.uint64(ky)]
            if y < 0:
                continue
            for kx in range(taps):
                # Without branches: what is joined and new is hard to predict.
                x = x_of[np.uint64(kx)]
                place = np.uint64(y * nx + x) if x >= 0 else nowhere
                marked -= start[place]
                start[place] = 0
    start[nowhere] = -1
    return marked


@compiled(_CELLS, types.int64, out_array(types.uint64), out_array(types.int32))
def mark_points(cells: _Integers, nz: int, mask: _Masks, start: _Rows) -> int:
    """Set the bits of the points' cells, flat indices (M,) or -1, and return how many were not set before."""
    marked = 0
    for i in range(len(cells)):
        if cells[i] >= 0:
            column = cells[i] // nz
            marked += _mark(mask, start, np.uint64(column), _ONE << np.uint64(cells[i] - column * nz))
    return marked


@compiled(_CELLS, *_LINKS, types.int64, out_array(types.uint64), out_array(types.int32))
def mark_joined(
    cells: _Integers,
    z_links: _Integers,
    y_links: _Integers,
    x_links: _Integers,
    nx: int,
    mask: _Masks,
    start: _Rows,
) -> int:
    """Set the bits of the cells joined with these cells, and return how many were not set before.

    `cells`: (N,) flat indices; links: (cells along an axis, taps) indices along it; columns: (ny * nx,).
    """
    depth, width = len(z_links), len(x_links)
    taps = x_links.shape[1]
    if not len(mask) and depth == z_links.shape[1] == 1 and y_links.shape[1] == taps:
        if taps == 3:  # a number that the compiler knows
            return _mark_flat(cells, y_links, x_links, 3, nx, start)
        return _mark_flat(cells, y_links, x_links, taps, nx, start)
    marked = i = row = 0
    while i < len(cells):
        column = cells[i] // depth if depth > 1 else cells[i]
        bits = np.uint64(0)
        while i < len(cells) and cells[i] < (column + 1) * depth:
            for kz in range(z_links.shape[1]):
                z = z_links[np.uint64(cells[i] - column * depth), np.uint64(kz)]
                if z >= 0:
                    bits |= _ONE << np.uint64(z)
            i += 1
        while column >= (row + 1) * width:
            row += 1
        x_of = x_links[np.uint64(column - row * width)]
        for ky in range(y_links.shape[1]):
            y = y_links[np.uint64(row), np.uint64(ky)]
            if y < 0:
                continue
            for kx in range(len(x_of)):
                x = x_of[np.uint64(kx)]
                if x >= 0:
                    marked += _mark(mask, start, np.uint64(y * nx + x), bits)
    return marked


@compiled(in_array(types.uint64), out_array(types.int32), types.int64, out_array(types.int64))
def list_cells(mask: _Masks, start: _Rows, nz: int, cells: _Integers) -> None:
    """List the cells whose bits are set, ascending flat indices (N,), and where each column (ny * nx,) starts.

    `cells` comes with room for one more.
    """
    count = 0
    if nz == 1:
        for column in range(len(start) - 1):
            missing = start[np.uint64(column)] >> 31  # -1 or 0: no branches
            cells[np.uint64(count)] = column
            start[np.uint64(column)] = count | missing
            count += 1 + missing
        return
    for column in range(len(mask)):
        left = mask[np.uint64(column)]
        if left == 0:
            continue
        start[column] = count
        while left:
            lowest = left & (~left + _ONE)
            cells[count] = column * nz + bits_set(lowest - _ONE)
            left ^= lowest
            count += 1


@inner
def _fill_flat(
    cells: _Integers,
    y_links: _Integers,
    x_links: _Integers,
    taps: int,
    nx: int,
    start: _Rows,
    missing: np.int32,
    rulebook: _Rows,
) -> None:
    """Compute `fill_rulebook` where both lattices are one cell high and the kernel is square, several times as fast."""
    nowhere, width = np.uint64(len(start) - 1), len(x_links)
    row = 0
    for i in range(len(cells)):
        while cells[i] >= (row + 1) * width:
            row += 1
        x_of, entries = x_links[np.uint64(cells[i] - row * width)], rulebook[np.uint64(i)]
        for ky in range(taps):
            y = y_links[np.uint64(row), np.uint64(ky)]
            for kx in range(taps):
                # Without branches: which cells are active is hard to predict. Unsigned, -1 is the largest number.
                x = x_of[np.uint64(kx)]
                place = np.uint64(y * nx + x) if (y | x) >= 0 else nowhere
                entries[np.uint64(ky * taps + kx)] = np.int32(min(np.uint32(start[place]), np.uint32(missing)))


@compiled(_CELLS, *_LINKS, types.int64, *_COLUMNS, types.int32, out_array(types.int32, 2))
def fill_rulebook(
    cells: _Integers,
    z_links: _Integers,
    y_links: _Integers,
    x_links: _Integers,
    nx: int,
    mask: _Masks,
    start: _Rows,
    missing: np.int32,
    rulebook: _Rows,
) -> None:
    """Compute `CellMap.rulebook`, column by column: cells (N,) -> indices (N, K)."""
    depth, width = len(z_links), len(x_links)
    taps_z, taps_y, taps_x = z_links.shape[1], y_links.shape[1], x_links.shape[1]
    if not len(mask) and depth == taps_z == 1 and taps_y == taps_x:
        if taps_x == 3:  # a number that the compiler knows
            _fill_flat(cells, y_links, x_links, 3, nx, start, missing, rulebook)
        else:
            _fill_flat(cells, y_links, x_links, taps_x, nx, start, missing, rulebook)
        return
    first = row = 0
    while first < len(cells):
        column = cells[first] // depth if depth > 1 else cells[first]
        end = first + 1
        while end < len(cells) and cells[end] < (column + 1) * depth:
            end += 1
        while column >= (row + 1) * width:
            row += 1
        x_of = x_links[np.uint64(column - row * width)]
        for ky in range(taps_y):
            y = y_links[np.uint64(row), np.uint64(ky)]
            for kx in range(taps_x):
                x = x_of[np.uint64(kx)]
                bits, begin = np.uint64(0), np.int32(0)
                if y >= 0 and x >= 0:
                    place = np.uint64(y * nx + x)
                    bits, begin = bits_of(mask, start, place), start[place]
                for i in range(first, end):
                    z_of, entries = z_links[np.uint64(cells[i] - column * depth)], rulebook[np.uint64(i)]
                    for kz in range(taps_z):
                        entry = missing
                        z = z_of[np.uint64(kz)]
                        bit = _ONE << np.uint64(max(z, 0))
                        if z >= 0 and bits & bit:
                            entry = begin + np.int32(bits_set(bits & (bit - _ONE)))
                        entries[np.uint64((kz * taps_y + ky) * taps_x + kx)] = entry
        first = end


@compiled(_CELLS, types.int64, types.int64, in_array(types.int32), types.int32, types.int64, out_array(types.int32))
def fill_places(
    cells: _Integers,
    nx: int,
    parent_nx: int,
    start: _Rows,
    missing: np.int32,
    halvings: int,
    places: _Rows,
) -> None:
    """Compute `CellMap.places`: cells (N,) -> indices (N,)."""
    row, within = 0, (1 << halvings) - 1
    for i in range(len(cells)):
        while cells[i] >= (row + 1) * nx:
            row += 1
        x = cells[i] - row * nx
        parent = np.uint64((row >> halvings) * parent_nx + (x >> halvings))
        place = (((np.int64(start[parent]) << halvings) + (row & within)) << halvings) + (x & within)
        places[np.uint64(i)] = np.int32(min(np.uint32(place), np.uint32(missing)))
