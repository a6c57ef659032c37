"""The built-in benchmark: synthetic colons made from seeds, every row judged on the same work, two runs compared."""

from densify.bench.record import BenchFile, read_bench
from densify.bench.scenes import SUITE_VERSION, Scene, scenes
from densify.bench.verdict import Comparison, compare
from densify.bench.work import BenchConfig, run_scene

__all__ = [
    "SUITE_VERSION",
    "BenchConfig",
    "BenchFile",
    "Comparison",
    "Scene",
    "compare",
    "read_bench",
    "run_scene",
    "scenes",
]
