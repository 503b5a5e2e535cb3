"""The paper's own numbers, to stand beside ours; each block names the table (its label in the paper's source)."""

from __future__ import annotations

DATASETS = ("Middlebury", "Booster", "WildRGBD", "Tanks", "ETH3D", "LLFF")
DISPARITIES = (0.3, 0.4, 0.5)  # S1, S2, S3
BASE_GAUSSIANS = 1_179_648  # SHARP's, in every table
METHODS = ("SHARP", "Spackle")

# tab:large_view_nr_iqa. (dataset, method): CLIPIQA, NIQE, MUSIQ at S1, then S2, then S3.
QUALITY: dict[tuple[str, str], tuple[float, ...]] = {
    ("Middlebury", "SHARP"): (0.3904, 4.3102, 58.2782, 0.3913, 4.2697, 57.7797, 0.3926, 4.1992, 56.8124),
    ("Middlebury", "Spackle"): (0.3921, 4.3127, 58.1583, 0.3969, 4.2825, 57.6487, 0.4032, 4.2268, 56.9233),
    ("Booster", "SHARP"): (0.4221, 5.1467, 55.7906, 0.4314, 5.1630, 55.0354, 0.4397, 5.1894, 54.6178),
    ("Booster", "Spackle"): (0.4224, 5.1466, 55.7929, 0.4325, 5.1625, 54.9989, 0.4443, 5.1868, 54.5166),
    ("WildRGBD", "SHARP"): (0.2782, 4.3972, 45.2073, 0.2595, 4.4207, 42.3572, 0.2451, 4.4680, 39.9257),
    ("WildRGBD", "Spackle"): (0.2858, 4.3422, 45.2259, 0.2676, 4.2775, 42.7294, 0.2533, 4.2471, 40.6128),
    ("Tanks", "SHARP"): (0.3536, 3.1289, 60.9697, 0.3666, 3.2049, 60.2709, 0.3820, 3.3647, 59.8877),
    ("Tanks", "Spackle"): (0.3793, 3.1858, 61.1473, 0.3955, 3.2137, 60.4960, 0.4126, 3.2472, 60.1183),
    ("ETH3D", "SHARP"): (0.3820, 3.5688, 64.7636, 0.3863, 3.5976, 63.5485, 0.3994, 3.6497, 62.5826),
    ("ETH3D", "Spackle"): (0.4020, 3.5732, 65.0792, 0.4126, 3.6095, 63.9991, 0.4274, 3.6353, 63.1081),
    ("LLFF", "SHARP"): (0.4601, 3.6783, 65.2599, 0.4574, 3.6185, 64.1105, 0.4566, 3.6132, 63.0390),
    ("LLFF", "Spackle"): (0.4719, 3.6670, 65.4440, 0.4779, 3.6251, 64.2562, 0.4843, 3.6028, 63.1472),
}
QUALITY_FIGURES = ("clipiqa", "niqe", "musiq")

# tab:controlled_disocclusion. SHARP's HAR, Spackle's HAR, reduction in percent at S1, then S2, then S3.
HOLES: dict[str, tuple[float, ...]] = {
    "Middlebury": (0.0121, 0.0011, 90.47, 0.0305, 0.0035, 88.52, 0.0566, 0.0084, 85.13),
    "Booster": (0.0036, 0.0003, 91.84, 0.0103, 0.0006, 94.51, 0.0242, 0.0011, 95.40),
    "WildRGBD": (0.0503, 0.0043, 91.37, 0.0885, 0.0166, 81.29, 0.1286, 0.0338, 73.75),
    "Tanks": (0.1464, 0.0369, 74.77, 0.2177, 0.0569, 73.83, 0.2794, 0.0620, 77.81),
    "ETH3D": (0.0680, 0.0120, 82.33, 0.1181, 0.0261, 77.87, 0.1720, 0.0406, 76.41),
    "LLFF": (0.0440, 0.0045, 89.67, 0.0818, 0.0129, 84.18, 0.1226, 0.0229, 81.29),
}

# tab:efficiency_gaussian_overhead and tab:expanded_efficiency_gaussian_overhead.
# Added Gaussians, their share of the base in percent and merged Gaussians at S1, then S2, then S3.
GAUSSIANS: dict[str, tuple[float, ...]] = {
    "Middlebury": (3387, 0.29, 1183035, 8501, 0.72, 1188149, 15782, 1.34, 1195430),
    "Booster": (1074, 0.09, 1180722, 3077, 0.26, 1182725, 7226, 0.61, 1186874),
    "WildRGBD": (3823, 0.32, 1183471, 6755, 0.57, 1186403, 9826, 0.83, 1189474),
    "Tanks": (33817, 2.87, 1213465, 50254, 4.26, 1229902, 64466, 5.46, 1244114),
    "ETH3D": (18663, 1.58, 1198311, 32382, 2.75, 1212030, 47105, 3.99, 1226753),
    "LLFF": (8425, 0.71, 1188073, 15629, 1.32, 1195277, 23397, 1.98, 1203045),
}
# The averages and medians of the first of them: added Gaussians and their share; milliseconds and percent.
AVERAGE = (11532, 0.98, 19433, 1.65, 27967, 2.37)
MEDIAN_BASE_MS = (1412.0, 1411.8, 1411.8)
MEDIAN_SPACKLE_MS = (1449.8, 1454.4, 1474.0)
MEDIAN_OVERHEAD = (2.7, 3.0, 4.4)

# tab:expanded_efficiency_gaussian_overhead: milliseconds of SHARP from the photo to one view, with Spackle, overhead in
# percent, views a second of both, at S1, then S2, then S3; on a machine that the paper does not name.
_TIMES = (
    (6410.3, 1449.4, -3.3, 0.671, 0.691, 1448.8, 1452.7, 0.8, 0.695, 0.689, 1448.4, 1476.4, 2.5, 0.695, 0.679),
    (1427.8, 1451.4, 1.9, 0.703, 0.691, 1427.6, 1456.1, 2.3, 0.703, 0.689, 1427.9, 1471.6, 3.3, 0.703, 0.682),
    (1419.8, 1443.8, 1.9, 0.709, 0.697, 1419.6, 1449.3, 2.3, 0.709, 0.694, 1419.6, 1459.5, 3.0, 0.709, 0.689),
    (1404.1, 1519.5, 8.4, 0.716, 0.661, 1403.9, 1566.8, 11.8, 0.716, 0.641, 1403.9, 1607.5, 14.7, 0.716, 0.625),
    (1371.2, 1450.1, 5.8, 0.730, 0.691, 1371.0, 1490.4, 8.8, 0.730, 0.673, 1370.9, 1533.4, 11.9, 0.730, 0.654),
    (1360.8, 1405.3, 3.3, 0.735, 0.712, 1360.6, 1424.1, 4.7, 0.735, 0.703, 1360.5, 1447.3, 6.4, 0.735, 0.692),
)  # fmt: skip
TIMES: dict[str, tuple[float, ...]] = dict(zip(DATASETS, _TIMES, strict=True))
ODD_TIME = ("Middlebury", 0.3)  # the entry whose numbers contradict each other: 0.671 FPS is 1,490 ms

# The same table's text and caption: parameters in millions, and the residual's share of SHARP's in percent.
PARAMETERS_M, MERGED_PARAMETERS_M, ADDED_PARAMETERS_M, ADDED_PARAMETERS_PERCENT = 702.31, 710.32, 8.02, 1.14

# Its column n: how many images a dataset has.
IMAGES = {"Middlebury": 23, "Booster": 228, "WildRGBD": 512, "Tanks": 512, "ETH3D": 454, "LLFF": 305}

# tab:near_view. (method, dataset): DISTS, LPIPS.
NEAR: dict[tuple[str, str], tuple[float, float]] = {
    ("SHARP", "Middlebury"): (0.0875, 0.3675),
    ("SHARP", "Booster"): (0.0872, 0.3076),
    ("SHARP", "WildRGBD"): (0.0451, 0.2002),
    ("SHARP", "Tanks"): (0.5238, 0.7392),
    ("SHARP", "ETH3D"): (0.3644, 0.6627),
    ("SHARP", "LLFF"): (0.4837, 0.7154),
    ("Direct FT", "Middlebury"): (0.1506, 0.4447),
    ("Direct FT", "Booster"): (0.1390, 0.3740),
    ("Direct FT", "WildRGBD"): (0.0662, 0.2414),
    ("Direct FT", "Tanks"): (0.5698, 0.7602),
    ("Direct FT", "ETH3D"): (0.4501, 0.7261),
    ("Direct FT", "LLFF"): (0.6042, 0.7325),
    ("Spackle", "Middlebury"): (0.0874, 0.3674),
    ("Spackle", "Booster"): (0.0871, 0.3075),
    ("Spackle", "WildRGBD"): (0.0451, 0.2004),
    ("Spackle", "Tanks"): (0.4839, 0.7313),
    ("Spackle", "ETH3D"): (0.3318, 0.6425),
    ("Spackle", "LLFF"): (0.4589, 0.7180),
}
NEAR_METHODS = ("SHARP", "Direct FT", "Spackle")

# tab:mask_guided_init. Aux Gaussians of the dense grid, its DISTS and LPIPS;
# aux Gaussians, reduction in percent, DISTS and LPIPS guided by the mask.
ABLATION: dict[str, tuple[float, ...]] = {
    "Middlebury": (414018.78, 0.0874, 0.3674, 330.65, 99.92, 0.0874, 0.3674),
    "Booster": (431616.00, 0.0871, 0.3075, 144.17, 99.97, 0.0871, 0.3075),
    "WildRGBD": (76800.00, 0.0450, 0.2002, 91.11, 99.88, 0.0451, 0.2004),
    "Tanks": (331776.00, 0.4839, 0.7313, 193131.43, 41.79, 0.4839, 0.7313),
    "ETH3D": (393246.72, 0.3319, 0.6425, 167031.80, 57.52, 0.3318, 0.6425),
    "LLFF": (190512.00, 0.4589, 0.7180, 96824.65, 49.18, 0.4589, 0.7180),
}


def at(numbers: tuple[float, ...] | None, disparity: float) -> tuple[float | None, ...]:
    """A disparity's third of the numbers (three where there are none), or as often None where the paper has none."""
    size = 3 if numbers is None else len(numbers) // len(DISPARITIES)
    if numbers is None or disparity not in DISPARITIES:
        return (None,) * size
    start = size * DISPARITIES.index(disparity)
    return numbers[start : start + size]
