"""EPSG codes of projected and vertical CRSs whose unit is not the metre.

`geo_keys` looks units up here where GeoTIFF keys give the code of a CRS but not its unit. From the EPSG data set as
PROJ 9 holds it; a code that is not listed here is taken for metres, as most are.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

_PROJECTED = {
    1200 / 3937: (
        "2155 2194 2204 2225-2250 2254-2255 2257-2264 2267-2268 2271-2272 2274-2279 2283-2289 2870-2895 2899-2900 "
        "2902-2908 2911-2912 2915-2920 2924-2930 2964-2968 3089 3091 3102 3363 3365 3404 3417-3438 3441-3446 "
        "3451-3459 3485 3487 3490-3512/2 3515-3553/2 3560-3570 3582-3586/2 3598 3600 3608-3632/2 3640 3642 "
        "3650-3654/2 3658-3664/2 3668-3674/2 3677 3680 3683 3686-3692/2 3696-3700/2 3728-3739 3753-3760 3991-3992 "
        "4217 4399-4413 4418-4433 4438-4457 5623-5625 5646 5654-5655 6200-6202 6411 6413 6416-6438/2 6441-6479/2 "
        "6484-6492/2 6501-6507/2 6510 6517-6543/2 6549-6555/2 6563 6565 6568 6572-6578/2 6582-6590/2 6593-6609/2 "
        "6612-6618/2 6625-6627 6633 6880 6923 6925 6966 6997 7057-7070 7128 7132 7258-7370/2 7587-7645 8035-8036 "
        "8091 8093 8096-8172/2 8177 8180 8182 8185 8189 8193 8197 8200-8210/2 8213 8216 8220 8224 8226 8380-8384/2 "
        "8387 8518-8540 9748-9749 10481-10516 10622 23301-23333 26729-26813 26847-26870 32001-32058 32064-32077 "
        "32099 32164-32167 32664-32667"
    ),
    0.3048: (
        "2222-2224 2251-2253 2256 2265-2266 2269-2270 2273 2280-2282 2867-2869 2896-2898 2901 2909-2910 2913-2914 "
        "2921-2923 2992 2994 3080 3359 3361 3479-3483/2 3588 3590 3593 3605 3634 3636 3644-3648/2 3656 3676 3679 "
        "3682 5588 6128-6141 6391 6405-6409/2 6494 6496 6499 6515 6545 6547 6557-6561/2 6570 6785-6863/2 6868 6885 "
        "6887 7119-7127 8065-8068 8312-8348/2 20050"
    ),
    1.0000135965: "29371-29385",
    0.9143985307444408: "24370-24374 24382",
    0.3047972654: "2314 3407 5589 24100",
    0.3047997101815088: "2136 2159-2160",
    0.201166195164: "2066 30200",
    0.201168: "3139-3140",
    0.9143984146160287: "27291-27292",
    0.3047994715386762: "29872",
    0.9143917962: "5472",
    20.116756: "3167",
    20.116765121552632: "29871",
    20.116782494375872: "24571",
    1000.0: "22300",
}
"""Codes of projected CRSs by the size of their unit [m]; `a-b`: all from a to b, `a-b/2`: every second one."""

_VERTICAL = {
    0.3048: "5614 6130-6132 8050-8051 8228 8897",
    1200 / 3937: "5702 6358-6360 8052-8053",
    0.3048007491: "5754",
}
"""The same of vertical CRSs."""


def find_unit(code: int, *, vertical: bool = False) -> float | None:
    """Metres per unit of a CRS by its EPSG code; None for metres and for codes that are not known."""
    return _units(vertical).get(code)


@functools.cache
def _units(vertical: bool) -> dict[int, float]:
    table = _VERTICAL if vertical else _PROJECTED
    return {code: unit for unit, codes in table.items() for text in codes.split() for code in _expand(text)}


def _expand(text: str) -> Iterator[int]:
    span, _, step = text.partition("/")
    first, _, last = span.partition("-")
    return iter(range(int(first), int(last or first) + 1, int(step or 1)))
