"""The first page of each verb's help: two examples, and which of its options are shown.

Plain options are everyday ones but for those that a page calls rare; options of a group (with a dot) are shown by
`--help-all` only, but for those that a page adds.
"""

from __future__ import annotations

from dataclasses import dataclass

_ALWAYS_RARE = (
    *("print_config", "map_sensor", "time_tolerance", "map_folder", "frame_offset", "keep_names", "polish_map"),
    "device",
)


@dataclass(frozen=True)
class Page:
    """What `lightdepth VERB --help` shows."""

    examples: tuple[str, ...] = ()
    """Commands as they are typed."""
    rare: tuple[str, ...] = ()
    """Plain options that are left to --help-all."""
    more: tuple[str, ...] = ()
    """Options of groups that are shown all the same."""

    def shows(self, name: str) -> bool:
        """Whether an option is an everyday one."""
        return name in self.more or ("." not in name and name not in self.rare and name not in _ALWAYS_RARE)


PAGES = {
    "demo": Page(("lightdepth demo", "lightdepth demo -o runs/fisheye --lens fisheye --seed 11 --frames 60")),
    "doctor": Page(("lightdepth doctor", "lightdepth doctor && lightdepth demo")),
    "synth": Page(
        (
            "lightdepth synth -o runs/colon --errors.side-share 0.3 --errors.side-factor 1.2",
            "lightdepth synth -o runs/real --family realistic --frames 80 --travel-mm 60",
        ),
        more=("slam.maps", "slam.kind"),
    ),
    "import": Page(
        (
            "lightdepth import video.mp4 -o data/mine --camera camera.json",
            "lightdepth import video.mp4 -o report --rate 2 --start 60 --end 300 --no-frames",
        ),
        rare=("every", "deinterlace", "find_text", "blur", "max_frames"),
        more=("keep_names",),
    ),
    "calibrate-light": Page(
        (
            "lightdepth calibrate-light data/mine --map runs/slam -o light.json",
            "lightdepth calibrate-light board --camera camera.json --position charuco --board.squares [9,7] "
            "--board.square-mm 4 --board.marker-mm 3 -o light.json",
        ),
        more=("board.squares", "board.square_mm", "board.marker_mm", "board.dictionary"),
    ),
    "convert-camera": Page(
        (
            "lightdepth convert-camera camera.yaml -o camera.json",
            "lightdepth convert-camera calib_results.txt -o cameras.txt --model OPENCV_FISHEYE --mask mask.png",
        )
    ),
    "select": Page(
        (
            "lightdepth select data/mine -o frames.txt",
            "lightdepth select data/mine -o frames.txt --map runs/slam",
        )
    ),
    "train": Page(
        (
            "lightdepth train --config configs/train/tube_smoke.yaml -o runs/smoke",
            "lightdepth train --config configs/train/lightdepth.yaml -o runs/mine --data.sequences data/mine",
        ),
        more=(
            "data.sequences",
            "data.val_sequences",
            "data.size",
            "data.batch_size",
            "data.num_workers",
            "data.tube.scenes",
            "data.tube.family",
            "model.network.kind",
            "model.learning_rate",
            "model.start",
            "trainer.max_steps",
            "trainer.accelerator",
            "trainer.precision",
        ),
    ),
    "adapt": Page(
        (
            "lightdepth adapt data/mine -o runs/mine --map runs/slam",
            "lightdepth adapt data/mine -o runs/mine --steps 600 --more data/others --what decoder",
        ),
        rare=("rank", "anchor", "replay", "points", "overlap", "held_out", "keep_worse", "bit_depth", "fov"),
    ),
    "ablate": Page(
        (
            "lightdepth ablate --config configs/ablation/lightdepth.yaml -o runs/ablation",
            "lightdepth ablate --config configs/ablation/lightdepth.yaml -o runs/ablation --seeds 0 --table table.md",
        )
    ),
    "predict": Page(
        (
            "lightdepth predict data/mine -o runs/depth",
            "lightdepth predict data/mine -o runs/depth --checkpoint runs/smoke/model.safetensors --no-previews",
        )
    ),
    "sparse": Page(
        (
            "lightdepth sparse data/mine -o runs/map --poses trajectory.tum --mask mask.png",
            "lightdepth sparse data/mine -o runs/map --repair maps/slam",
        ),
        more=("sfm.matching", "sfm.max_features", "sfm.peak_threshold", "sfm.num_threads", "sfm.seed"),
    ),
    "densify": Page(
        (
            "lightdepth densify data/mine --map runs/slam -o runs/dense",
            "lightdepth densify data/mine -o runs/dense --mm-per-unit 3.1 --formats '[ply, glb]'",
        ),
        rare=("keep_mb", "wall_mm"),
        more=("fusion.voxel",),
    ),
    "batch": Page(
        (
            "lightdepth batch data -o runs/night --map slam --jobs 4",
            "lightdepth batch procedures.csv -o runs/all --shard 2/8 --merging.by points",
        ),
        rare=("keep_mb", "threads", "bit_depth", "trust_map", "recipe", "fov"),
    ),
    "live": Page(
        (
            "lightdepth live data/mine --map runs/slam -o runs/live",
            "lightdepth live data/mine --map runs/slam -o runs/live --rate 5 --budget-ms 100",
        ),
        more=("fusion.voxel",),
    ),
    "evaluate": Page(
        (
            "lightdepth evaluate runs/dense --truth data/mine",
            "lightdepth evaluate runs/slam --truth data/mine -o runs/errors --thresholds-mm '[1, 3]'",
        ),
        rare=("trajectory", "truth_mesh", "common", "join", "keep_mb", "bit_depth"),
    ),
    "bench": Page(
        (
            "lightdepth bench -o runs/a",
            "lightdepth bench -o runs/b --alignment.estimator median && lightdepth bench compare runs/a runs/b",
        )
    ),
    "bench compare": Page(
        (
            "lightdepth bench compare runs/a runs/b",
            "lightdepth bench compare runs/a runs/b -o comparison.json",
        )
    ),
    "bench estimators": Page(
        (
            "lightdepth bench estimators -o runs/estimators",
            "lightdepth bench estimators -o runs/estimators --draws 200 --points 50",
        )
    ),
    "bench per-frame": Page(
        (
            "lightdepth bench per-frame -o runs/per-frame",
            "lightdepth bench per-frame -o runs/mine --colons runs/per-frame/colons --checkpoints '[mine.safetensors]'",
        )
    ),
    "bench completion": Page(
        (
            "lightdepth bench completion -o runs/completion --inputs true",
            "lightdepth bench completion -o runs/beside --external '[mine=runs/mine]'",
        )
    ),
    "bench speed": Page(
        (
            "lightdepth bench speed -o runs/speed",
            "lightdepth bench speed -o runs/large --image-sizes '[[1440, 1080]]' --seconds 3",
        )
    ),
    "scale": Page(
        (
            "lightdepth scale runs/dense --light light.json",
            "lightdepth scale runs/dense --length.ends '[[0, 0, 30], [4, 2, 31]]' --length.mm 5 --length.error-mm 0.3",
        ),
        more=("length.ends", "length.mm", "length.error_mm", "length.map"),
    ),
    "measure": Page(
        (
            "lightdepth measure runs/dense --points '[[0, 0, 30], [4, 2, 41]]' --mm-per-unit 3.1",
            "lightdepth measure runs/dense --frame 120 --pixels '[[310, 200], [420, 260]]'",
        )
    ),
    "view": Page(
        (
            "lightdepth view runs/dense",
            "lightdepth view runs/live --data DATA --rerun live.rrd",
        )
    ),
    "completion": Page(
        (
            "lightdepth completion bash > ~/.local/share/bash-completion/completions/lightdepth",
            "lightdepth completion fish > ~/.config/fish/completions/lightdepth.fish",
        )
    ),
    "export": Page(
        (
            "lightdepth export runs/dense -o runs/colmap --to colmap",
            "lightdepth export runs/mine/model.safetensors -o runs/onnx --to onnx",
        )
    ),
}
