"""The paper's published numbers, which tables and plots show beside measured ones.

Each row of a table has one tuple of numbers for each setting. A setting is S1, S2 or S3, that is,
a camera move of disparity 0.3, 0.4 or 0.5; tables of near views (at the viewpoints of second
photos) have one setting. A metric whose name ends with "_percent" is in percent, "_ms" in
milliseconds, "_fps" in views per second; "aux" counts the Gaussians that Spackle adds to those of
the base, the network that makes the scene.
"""

from __future__ import annotations

import dataclasses

PAPER_SETTINGS = ("0.3", "0.4", "0.5")  # disparities of the paper's settings S1, S2 and S3, as text
PAPER_DISPARITIES = (0.3, 0.4, 0.5)

# The number of images of each dataset, in the order of the paper's tables.
PAPER_IMAGE_COUNTS = {
    "Middlebury": 23,
    "Booster": 228,
    "WildRGBD": 512,
    "Tanks": 512,
    "ETH3D": 454,
    "LLFF": 305,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class PaperParameters:
    """The paper's counts of network parameters, in millions."""

    base_m: float  # of SHARP
    merged_m: float  # of SHARP and the residual network together
    residual_m: float  # of the residual network
    share_percent: float  # the residual's count over SHARP's


PAPER_PARAMETERS = PaperParameters(
    base_m=702.31, merged_m=710.32, residual_m=8.02, share_percent=1.14
)


@dataclasses.dataclass(frozen=True)
class PaperRow:
    """The numbers of one dataset and method in a table of the paper."""

    dataset: str
    method: str  # as a table shows it; ends with " (paper)"
    values_by_setting: tuple[tuple[float, ...], ...]  # for each setting, a number for each metric


@dataclasses.dataclass(frozen=True, kw_only=True)
class PaperTable:
    """A table of the paper, or a part of a table whose rows have the same metrics."""

    label: str  # in the paper's LaTeX source
    metrics: tuple[str, ...]
    rows: tuple[PaperRow, ...]


PAPER_TABLES = (
    PaperTable(
        label="tab:large_view_nr_iqa",
        metrics=("clipiqa", "niqe", "musiq"),
        rows=(
            PaperRow(
                "Middlebury",
                "SHARP (paper)",
                ((0.3904, 4.3102, 58.2782), (0.3913, 4.2697, 57.7797), (0.3926, 4.1992, 56.8124)),
            ),
            PaperRow(
                "Middlebury",
                "Spackle (paper)",
                ((0.3921, 4.3127, 58.1583), (0.3969, 4.2825, 57.6487), (0.4032, 4.2268, 56.9233)),
            ),
            PaperRow(
                "Booster",
                "SHARP (paper)",
                ((0.4221, 5.1467, 55.7906), (0.4314, 5.163, 55.0354), (0.4397, 5.1894, 54.6178)),
            ),
            PaperRow(
                "Booster",
                "Spackle (paper)",
                ((0.4224, 5.1466, 55.7929), (0.4325, 5.1625, 54.9989), (0.4443, 5.1868, 54.5166)),
            ),
            PaperRow(
                "WildRGBD",
                "SHARP (paper)",
                ((0.2782, 4.3972, 45.2073), (0.2595, 4.4207, 42.3572), (0.2451, 4.468, 39.9257)),
            ),
            PaperRow(
                "WildRGBD",
                "Spackle (paper)",
                ((0.2858, 4.3422, 45.2259), (0.2676, 4.2775, 42.7294), (0.2533, 4.2471, 40.6128)),
            ),
            PaperRow(
                "Tanks",
                "SHARP (paper)",
                ((0.3536, 3.1289, 60.9697), (0.3666, 3.2049, 60.2709), (0.382, 3.3647, 59.8877)),
            ),
            PaperRow(
                "Tanks",
                "Spackle (paper)",
                ((0.3793, 3.1858, 61.1473), (0.3955, 3.2137, 60.496), (0.4126, 3.2472, 60.1183)),
            ),
            PaperRow(
                "ETH3D",
                "SHARP (paper)",
                ((0.382, 3.5688, 64.7636), (0.3863, 3.5976, 63.5485), (0.3994, 3.6497, 62.5826)),
            ),
            PaperRow(
                "ETH3D",
                "Spackle (paper)",
                ((0.402, 3.5732, 65.0792), (0.4126, 3.6095, 63.9991), (0.4274, 3.6353, 63.1081)),
            ),
            PaperRow(
                "LLFF",
                "SHARP (paper)",
                ((0.4601, 3.6783, 65.2599), (0.4574, 3.6185, 64.1105), (0.4566, 3.6132, 63.039)),
            ),
            PaperRow(
                "LLFF",
                "Spackle (paper)",
                ((0.4719, 3.667, 65.444), (0.4779, 3.6251, 64.2562), (0.4843, 3.6028, 63.1472)),
            ),
        ),
    ),
    PaperTable(
        label="tab:controlled_disocclusion",
        metrics=("har_before", "har", "reduction_percent"),
        rows=(
            PaperRow(
                "Middlebury",
                "Spackle on SHARP (paper)",
                ((0.0121, 0.0011, 90.47), (0.0305, 0.0035, 88.52), (0.0566, 0.0084, 85.13)),
            ),
            PaperRow(
                "Booster",
                "Spackle on SHARP (paper)",
                ((0.0036, 0.0003, 91.84), (0.0103, 0.0006, 94.51), (0.0242, 0.0011, 95.4)),
            ),
            PaperRow(
                "WildRGBD",
                "Spackle on SHARP (paper)",
                ((0.0503, 0.0043, 91.37), (0.0885, 0.0166, 81.29), (0.1286, 0.0338, 73.75)),
            ),
            PaperRow(
                "Tanks",
                "Spackle on SHARP (paper)",
                ((0.1464, 0.0369, 74.77), (0.2177, 0.0569, 73.83), (0.2794, 0.062, 77.81)),
            ),
            PaperRow(
                "ETH3D",
                "Spackle on SHARP (paper)",
                ((0.068, 0.012, 82.33), (0.1181, 0.0261, 77.87), (0.172, 0.0406, 76.41)),
            ),
            PaperRow(
                "LLFF",
                "Spackle on SHARP (paper)",
                ((0.044, 0.0045, 89.67), (0.0818, 0.0129, 84.18), (0.1226, 0.0229, 81.29)),
            ),
        ),
    ),
    PaperTable(
        label="tab:expanded_efficiency_gaussian_overhead",
        metrics=(
            "aux",
            "aux_share_percent",
            "merged",
            "base_ms",
            "spackle_ms",
            "overhead_percent",
            "base_fps",
            "spackle_fps",
        ),
        rows=(
            PaperRow(
                "Middlebury",
                "Spackle on SHARP (paper)",
                (
                    (3387, 0.29, 1183035, 6410.3, 1449.4, -3.3, 0.671, 0.691),
                    (8501, 0.72, 1188149, 1448.8, 1452.7, 0.8, 0.695, 0.689),
                    (15782, 1.34, 1195430, 1448.4, 1476.4, 2.5, 0.695, 0.679),
                ),
            ),
            PaperRow(
                "Booster",
                "Spackle on SHARP (paper)",
                (
                    (1074, 0.09, 1180722, 1427.8, 1451.4, 1.9, 0.703, 0.691),
                    (3077, 0.26, 1182725, 1427.6, 1456.1, 2.3, 0.703, 0.689),
                    (7226, 0.61, 1186874, 1427.9, 1471.6, 3.3, 0.703, 0.682),
                ),
            ),
            PaperRow(
                "WildRGBD",
                "Spackle on SHARP (paper)",
                (
                    (3823, 0.32, 1183471, 1419.8, 1443.8, 1.9, 0.709, 0.697),
                    (6755, 0.57, 1186403, 1419.6, 1449.3, 2.3, 0.709, 0.694),
                    (9826, 0.83, 1189474, 1419.6, 1459.5, 3.0, 0.709, 0.689),
                ),
            ),
            PaperRow(
                "Tanks",
                "Spackle on SHARP (paper)",
                (
                    (33817, 2.87, 1213465, 1404.1, 1519.5, 8.4, 0.716, 0.661),
                    (50254, 4.26, 1229902, 1403.9, 1566.8, 11.8, 0.716, 0.641),
                    (64466, 5.46, 1244114, 1403.9, 1607.5, 14.7, 0.716, 0.625),
                ),
            ),
            PaperRow(
                "ETH3D",
                "Spackle on SHARP (paper)",
                (
                    (18663, 1.58, 1198311, 1371.2, 1450.1, 5.8, 0.73, 0.691),
                    (32382, 2.75, 1212030, 1371.0, 1490.4, 8.8, 0.73, 0.673),
                    (47105, 3.99, 1226753, 1370.9, 1533.4, 11.9, 0.73, 0.654),
                ),
            ),
            PaperRow(
                "LLFF",
                "Spackle on SHARP (paper)",
                (
                    (8425, 0.71, 1188073, 1360.8, 1405.3, 3.3, 0.735, 0.712),
                    (15629, 1.32, 1195277, 1360.6, 1424.1, 4.7, 0.735, 0.703),
                    (23397, 1.98, 1203045, 1360.5, 1447.3, 6.4, 0.735, 0.692),
                ),
            ),
        ),
    ),
    PaperTable(
        label="tab:efficiency_gaussian_overhead",
        metrics=("aux", "aux_share_percent", "base_ms", "spackle_ms", "overhead_percent"),
        rows=(
            PaperRow(
                "Average",
                "Spackle on SHARP (paper)",
                (
                    (11532, 0.98, 1412.0, 1449.8, 2.7),
                    (19433, 1.65, 1411.8, 1454.4, 3.0),
                    (27967, 2.37, 1411.8, 1474.0, 4.4),
                ),
            ),
        ),
    ),
    PaperTable(
        label="tab:near_view",
        metrics=("dists", "lpips"),
        rows=(
            PaperRow("Middlebury", "SHARP (paper)", ((0.0875, 0.3675),)),
            PaperRow("Booster", "SHARP (paper)", ((0.0872, 0.3076),)),
            PaperRow("WildRGBD", "SHARP (paper)", ((0.0451, 0.2002),)),
            PaperRow("Tanks", "SHARP (paper)", ((0.5238, 0.7392),)),
            PaperRow("ETH3D", "SHARP (paper)", ((0.3644, 0.6627),)),
            PaperRow("LLFF", "SHARP (paper)", ((0.4837, 0.7154),)),
            PaperRow("Middlebury", "Direct FT (paper)", ((0.1506, 0.4447),)),
            PaperRow("Booster", "Direct FT (paper)", ((0.139, 0.374),)),
            PaperRow("WildRGBD", "Direct FT (paper)", ((0.0662, 0.2414),)),
            PaperRow("Tanks", "Direct FT (paper)", ((0.5698, 0.7602),)),
            PaperRow("ETH3D", "Direct FT (paper)", ((0.4501, 0.7261),)),
            PaperRow("LLFF", "Direct FT (paper)", ((0.6042, 0.7325),)),
            PaperRow("Middlebury", "Spackle (paper)", ((0.0874, 0.3674),)),
            PaperRow("Booster", "Spackle (paper)", ((0.0871, 0.3075),)),
            PaperRow("WildRGBD", "Spackle (paper)", ((0.0451, 0.2004),)),
            PaperRow("Tanks", "Spackle (paper)", ((0.4839, 0.7313),)),
            PaperRow("ETH3D", "Spackle (paper)", ((0.3318, 0.6425),)),
            PaperRow("LLFF", "Spackle (paper)", ((0.4589, 0.718),)),
        ),
    ),
    PaperTable(
        label="tab:mask_guided_init",
        metrics=("base_gaussians", "aux", "dists", "lpips"),
        rows=(
            PaperRow(
                "Middlebury", "Dense grid init (paper)", ((1179648, 414018.78, 0.0874, 0.3674),)
            ),
            PaperRow("Booster", "Dense grid init (paper)", ((1179648, 431616.0, 0.0871, 0.3075),)),
            PaperRow("WildRGBD", "Dense grid init (paper)", ((1179648, 76800.0, 0.045, 0.2002),)),
            PaperRow("Tanks", "Dense grid init (paper)", ((1179648, 331776.0, 0.4839, 0.7313),)),
            PaperRow("ETH3D", "Dense grid init (paper)", ((1179648, 393246.72, 0.3319, 0.6425),)),
            PaperRow("LLFF", "Dense grid init (paper)", ((1179648, 190512.0, 0.4589, 0.718),)),
        ),
    ),
    PaperTable(
        label="tab:mask_guided_init",
        metrics=("base_gaussians", "aux", "aux_reduction_percent", "dists", "lpips"),
        rows=(
            PaperRow(
                "Middlebury",
                "Mask guided init (paper)",
                ((1179648, 330.65, 99.92, 0.0874, 0.3674),),
            ),
            PaperRow(
                "Booster", "Mask guided init (paper)", ((1179648, 144.17, 99.97, 0.0871, 0.3075),)
            ),
            PaperRow(
                "WildRGBD", "Mask guided init (paper)", ((1179648, 91.11, 99.88, 0.0451, 0.2004),)
            ),
            PaperRow(
                "Tanks", "Mask guided init (paper)", ((1179648, 193131.43, 41.79, 0.4839, 0.7313),)
            ),
            PaperRow(
                "ETH3D", "Mask guided init (paper)", ((1179648, 167031.8, 57.52, 0.3318, 0.6425),)
            ),
            PaperRow(
                "LLFF", "Mask guided init (paper)", ((1179648, 96824.65, 49.18, 0.4589, 0.718),)
            ),
        ),
    ),
)
