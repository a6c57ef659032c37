"""What a training run sees: frames read from disk, synthetic colons made on the spot, or both.

Everything random follows from `seed`: the order of the frames from the epoch, the augmentation from the step, so that a
resumed run sees what an uninterrupted one would have seen.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, cast

import lightning.pytorch as pl
import numpy as np
import torch
from torch.utils.data import ConcatDataset, DataLoader, Dataset, Sampler

from lightdepth.colour import Colours
from lightdepth.datasets import FormatName, SequenceSource
from lightdepth.datasets.coloured import LOOKED_AT, colours_of
from lightdepth.datasets.splits import check_apart, folders, read_split
from lightdepth.errors import InputError
from lightdepth.frame import FrameBatch
from lightdepth.ranges import BELOW_ONE, BETWEEN, SEED, Range, at_least, checked, ends_of
from lightdepth.reporting.progress import Progress
from train.augmentation import augmented, drawn_for
from train.colons import SceneMaker, TubeData, colon_seeds, tube_scene, val_scene, with_reflectance
from train.frame_cache import FrameCache, cache_root, check_outside
from train.frame_lists import Listed, listed_rows, open_listed
from train.frame_sets import Frames, Opened, Rendered, held_out_count
from train.kept_colons import KeptColons
from train.loader import Waited, loader
from train.order import ALONE, Halves, Parted, Place, Shuffled

_NO_TUBE = TubeData()
_LOOKED_AT = 256  # frames whose colours are looked at, of all sequences together


@dataclass(frozen=True)
@checked
class FrameData:
    """Which frames are trained and validated on, and how they are shown to the network."""

    sequences: list[str] | None = None
    """Folders of frames, or videos, to train on. Left out, --data.split or synthetic colons (--data.tube.scenes) have
    to be there."""
    val_sequences: list[str] | None = None
    """Folders of frames, or videos, to validate on: they teach nothing, and choose the best checkpoint. Left out, the
    end of each training sequence does that (--data.held-out)."""
    split: str | None = None
    """YAML file that says which sequences train and which validate (data/*/splits/*.yaml); its test sequences are never
    read. It takes the place of --data.sequences and --data.val-sequences, and needs --data.root."""
    root: str | None = None
    """Folder in which the sequences that --data.split names are looked for; given with it, and only with it."""
    frames: str | None = None
    """Text file with one frame name a line, as `lightdepth select` writes it: of the training sequences only these
    frames are used, those held out to validate on included. A line is `folder/name` where several sequences have frames
    of one name. Left out, all frames are used."""
    format: FormatName | None = None
    """Format of all the sequences: folder (images with camera.json), video, or the data set c3vd, simcol, hamlyn,
    scared, endoslam or endomapper. Left out, each is told by its files."""
    camera: str | None = None
    """Calibration file of the camera, for all the sequences in place of their own. Left out, each has its own."""
    light: str | None = None
    """Light of the endoscope, for all the sequences in place of their own: a light.json, a photometric XML, or values
    such as gamma=2.2,mu=0 (response and spread). Left out, each has its own, or an assumed one."""
    mask: str | None = None
    """Image, white where tissue shows and black elsewhere, for all the sequences in place of their own masks. Left out,
    each has its own, if any."""
    bit_depth: Annotated[int | None, Range(8, 32)] = None
    """Bits per sample of pictures that have more than 8, in all the sequences; left out, it is read from the files,
    else told by their highest values. A larger one reads the same numbers as darker."""
    held_out: Annotated[float, BETWEEN] = 0.1
    """Share of each training sequence, above 0 and below 1, at its end, that validates and teaches nothing, where no
    validation sequences are given. A larger one judges more surely and trains on less."""
    tube: TubeData = _NO_TUBE
    """Synthetic colons to train and validate on, besides the sequences or alone."""
    halves: bool = False
    """true: one half of each batch is frames of the sequences, the other of synthetic colons (of an odd number the
    sequences have one more). false: all are shuffled together, so that the kind with more frames has the larger part.
    Without both kinds it changes nothing."""
    size: Annotated[tuple[int, int], at_least(16, up_to=10_000)] = (160, 128)
    """Width and height that the images are resized to, pixels, to train, validate and predict at. A larger one shows
    finer detail and takes longer."""
    batch_size: Annotated[int, at_least(1, up_to=100_000)] = 4
    """Number of frames in a batch, from which the network learns at once. More make steadier steps and take more time
    and memory."""
    num_workers: Annotated[int, at_least(0, up_to=1024)] = 0
    """Number of extra processes that read frames; with 0 the main one reads them itself, between steps. More read
    faster, up to the number of cores."""
    cache: bool | str = False
    """Folder in which decoded frames are kept, at the size of training, for all epochs and later runs: some 1.5 MB each
    at 320x256. They are pictures of patients where the frames are. true: a folder of your own, below ~/.cache or
    XDG_CACHE_HOME. false: frames are decoded each time. It changes the time, and no result."""
    augment: bool = True
    """true: training images are flipped at random, and made brighter or darker by some 10 %. false: they are shown as
    they are. Validation images are never changed."""
    reflectance_error: Annotated[float, Range(-1, 1)] = 0.0
    """Number added to the known reflectance of each image (the share of light that the wall reflects onto other wall;
    the sum is kept in [0, 0.95]), to see what a wrong calibration costs; 0 adds nothing. A larger one makes it more
    wrong. Only --model.loss.reflectance null, or reflectance among --model.network.inputs, lets it have an effect."""
    random_reflectance: Annotated[tuple[float, float] | None, ends_of(BELOW_ONE)] = None
    """Range [low, high] of shares in [0, 1), from which the reflectance that is stated for each training image (the
    share of light that the wall reflects onto other wall) is drawn anew in every step; left out, the known one is
    stated. A larger one states more indirect light. Like reflectance_error, it has an effect only through
    --model.loss.reflectance null or the network's input."""
    seed: Annotated[int, SEED] = 0
    """Number that draws colons, order and augmentation. Another one makes another run."""

    def __post_init__(self) -> None:
        if self.halves and self.batch_size < 2:
            raise InputError("data", "halves of a batch of one", "expected a batch_size of at least 2")
        if self.split is not None and (self.sequences or self.val_sequences):
            raise InputError("data", "a split and sequences", "give --data.split FILE or --data.sequences, not both")
        if (self.split is None) != (self.root is None):
            raise InputError(
                "data",
                "a split without the root of its sequences, or the other way round",
                "give both: --data.split FILE --data.root DIR",
            )

    def source(self, path: str, format: str | None = None) -> SequenceSource:
        """How the sequence at `path` is read; `format` is that of its data set, where it is known."""
        camera, mask = (None if file is None else Path(file) for file in (self.camera, self.mask))
        known = cast("FormatName | None", format)  # dataset.yaml's is one of them: read_dataset_yaml looks
        return SequenceSource(Path(path), self.format or known, camera, self.light, mask, self.bit_depth)


class FrameDataModule(pl.LightningDataModule):
    """Training and validation frames, as FrameBatches of one size. Raises InputError where a sequence is in both."""

    def __init__(self, config: FrameData) -> None:
        super().__init__()
        self.config, self.tube, self.split = config, config.tube, config.split
        self.sequences, self.val_sequences = config.sequences or [], config.val_sequences or []
        self.size, self.batch_size = (int(config.size[0]), int(config.size[1])), config.batch_size
        self.colours: dict[str, Colours] = {}
        self._unread: dict[str, dict[str, str]] = {"train": {}, "val": {}}  # what is said of frames, by file
        self.tell: Callable[[str], None] = warn
        """takes a sentence on a frame that could not be read, when it is met"""
        self.parted = True
        """whether each process of a distributed run has frames of its own, or all of them have all"""
        self._sources: dict[str, SequenceSource] = {}
        self._unkept: list[str] = []
        self._waited = Waited()
        self._kept: KeptColons | None = None
        self._rendered: list[tuple[int, list[FrameBatch]]] = []  # colons by seed that are not kept yet
        check_apart(self.sequences, self.val_sequences)
        self._train: ConcatDataset[FrameBatch] | None = None
        self._val: ConcatDataset[FrameBatch] | None = None
        self._begun = (0, 0)

    def go_on(self, epoch: int, batch: int) -> None:
        """A run that is resumed begins with this batch of this epoch."""
        self._begun = epoch, batch

    def read_colons(self, root: Path) -> None:
        """`setup` takes colons from the folder `root` that were kept there, in the place of rendering them."""
        self._kept = KeptColons(root, self.tube, self.config.seed, self.size)

    def keep_colons(self) -> str:
        """Keeps the colons that `setup` rendered where it looked for them. Returns a sentence on those that are not."""
        rendered, self._rendered = self._rendered, []
        return self._kept.write(rendered) if self._kept is not None and rendered else ""

    def setup(self, stage: str | None = None) -> None:
        if self._train is not None:
            return
        opened = self.open_sequences()
        if self.config.cache:
            self._keep_decoded(opened)
        train: list[Dataset[FrameBatch]] = [*opened.train]
        val: list[Dataset[FrameBatch]] = [*opened.val]
        if self.tube.scenes + self.tube.val_scenes > 0:
            there = self._kept is not None and self._kept.folder.is_dir()
            told = "Reading rendered colons" if there else "Rendering synthetic colons"
            with Progress(told, self.tube.scenes + self.tube.val_scenes) as bar:
                to_train_on, to_validate_on = colon_seeds(self.tube, self.config.seed)
                train += self._colons(tube_scene, to_train_on, bar)
                val += self._colons(val_scene, to_validate_on, bar)
        self._train, self._val = ConcatDataset(train), ConcatDataset(val)
        most = int(np.clip(_LOOKED_AT // max(1, len(opened.listed)), 4, LOOKED_AT))
        for path, frames, listed in opened.listed:
            self.colours[path] = colours_of(frames, listed, most)

    def open_sequences(self) -> Opened:
        """Those to train and to validate on, and no colons. Raises InputError where there is, colons counted, nothing
        to train or to validate on."""
        train: list[Frames] = []
        val: list[Frames] = []
        to_train, to_validate = self._folders()
        opened = [(path, open_listed(self._source, path, of)) for path, of in to_train]
        rows = [list(range(len(frames))) for _, frames in opened]
        if self.config.frames is not None:
            if len(dict(opened)) < len(opened):
                raise InputError(
                    f"{self.split}",
                    "has one sequence twice in train",
                    "leave one, or leave out --data.frames, which cannot tell them apart",
                )
            rows = list(listed_rows(Path(self.config.frames), dict(opened)).values())
        for (path, frames), listed in zip(opened, rows, strict=True):
            if not listed:
                raise InputError(
                    path, f"none of its frames is listed in {self.config.frames}", "leave it out, or list some"
                )
            chosen = frames.at(listed)
            held_out = 0 if to_validate else held_out_count(len(chosen), self.config.held_out)
            if len(chosen) <= held_out:
                raise InputError(path, f"{len(chosen)} frame", "expected at least two, one of them to validate on")
            train.append(Frames(chosen[: len(chosen) - held_out], self.size, path))
            if held_out:
                val.append(Frames(chosen[-held_out:], self.size, path))
        for path, of in to_validate:
            val.append(Frames(open_listed(self._source, path, of), self.size, path))
        if (root := cache_root(self.config.cache)) is not None:
            check_outside(root, [*self.sequences, *self.val_sequences])
        if not train and not self.tube.scenes:
            raise InputError("data", "nothing to train on", "give --data.sequences FOLDER, or --data.tube.scenes N")
        if not val and not self.tube.val_scenes:
            raise InputError(
                "data", "nothing to validate on", "give --data.val-sequences FOLDER, or --data.tube.val-scenes N"
            )
        listed_of = [(path, frames, listed) for (path, frames), listed in zip(opened, rows, strict=True)]
        return Opened(train, val, listed_of)

    def _source(self, path: str, format: str | None = None) -> SequenceSource:
        self._sources[path] = self.config.source(path, format)
        return self._sources[path]

    def _keep_decoded(self, opened: Opened) -> None:
        """Has frames kept once they are decoded, if that is asked for."""
        root = cache_root(self.config.cache)
        parts: dict[str, list[Frames]] = {}
        for part in (*opened.train, *opened.val):
            parts.setdefault(part.path, []).append(part)
        for path, same in parts.items():
            first = next((batch for part in same if (batch := part.first()) is not None), None)
            if root is None or first is None:
                continue  # none of its frames can be read, which is said where they are asked for
            cache = FrameCache(root, self._sources[path], self.size, first)
            said = cache.prepare(sum(map(len, same)))
            self._unkept += [said] if said else []
            for part in same:
                part.cache = cache

    @property
    def doubts(self) -> list[str]:
        """Sentences on training sequences that are not what the light's decline can teach from, and on frames that
        could not be read until now."""
        coloured = [f"{path}: {doubt}" for path, colours in self.colours.items() for doubt in colours.doubts]
        return [*coloured, *self._unkept, *(said for part in self._unread.values() for said in part.values())]

    @property
    def unread(self) -> dict[str, int]:
        """Number of frames to train and to validate on that could not be read until now, in this process."""
        return {part: len(said) for part, said in self._unread.items()}

    def seconds_waited(self) -> float:
        """Seconds for which this process has waited for frames to train on."""
        return self._waited.seconds

    def gather(self) -> None:
        """Takes what the other processes of a distributed run could not read; each of them has to call it."""
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            everywhere: list[dict[str, dict[str, str]]] = [{}] * torch.distributed.get_world_size()
            torch.distributed.all_gather_object(everywhere, self._unread)
            for part, said in self._unread.items():
                for other in everywhere:
                    said |= other[part]

    def share(self, other: FrameDataModule) -> bool:
        """Takes the frames of `other`, which is set up, if they are what `setup` would read and render."""
        if self._origin() != other._origin():
            return False
        self._train, self._val, self.colours = other._train, other._val, other.colours
        return True

    def _origin(self) -> tuple[object, ...]:
        """What the frames follow from."""
        c = self.config
        read = (c.split, c.root, c.frames, c.format, c.camera, c.light, c.mask, c.bit_depth, c.held_out)
        return (self.sequences, self.val_sequences, *read, c.tube, self.size, c.seed)

    def _folders(self) -> list[list[tuple[str, Listed | None]]]:
        """The folders to train and to validate on, with what a split says of each; a split's become the sequences."""
        if self.split is None:
            return [[(path, None) for path in paths] for paths in (self.sequences, self.val_sequences)]
        split = read_split(Path(self.split))
        if "train" not in split.parts:
            raise InputError(self.split, "no train in it: it is a split to test with", "expected one to train with")
        assert self.config.root is not None
        found = folders(split, Path(self.config.root), ("train", "val"))
        both: list[list[tuple[str, Listed | None]]] = [
            [(str(folder), Listed(split, chosen)) for folder, chosen in found.get(part, [])]
            for part in ("train", "val")
        ]
        self.sequences, self.val_sequences = ([path for path, _ in part] for part in both)
        return both

    def _colons(self, make: SceneMaker, seeds: range, bar: Progress) -> list[Dataset[FrameBatch]]:
        made: list[Dataset[FrameBatch]] = []
        for i, seed in enumerate(seeds):
            frames = self._kept.frames(seed) if self._kept is not None else None
            if frames is None:
                frames = make(self.tube, seed, i, self.size)
                self._rendered += [(seed, frames)] if self._kept is not None else []
            made.append(Rendered(frames, [f"colon {seed} frame {k}" for k in range(len(frames))]))
            bar.advance()
        return made

    @property
    def counts(self) -> dict[str, int]:
        """Number of frames to train and to validate on."""
        assert self._train is not None and self._val is not None, "setup() first"
        return {"train": len(self._train), "val": len(self._val)}

    def names(self, epoch: int, batch: int) -> list[str]:
        """Names of the training frames of a batch of an epoch, in this process."""
        assert self._train is not None, "setup() first"
        order = self._order()
        order.set_epoch(epoch)
        everyone = [name for part in self._train.datasets for name in part.names]  # type: ignore[attr-defined]  # ours have
        return [everyone[i] for i in Parted(order, self.batch_size, self._place()).batch(batch)]

    def _place(self) -> Place:
        if self.trainer is None or not self.parted:
            return ALONE
        return Place(self.trainer.global_rank, self.trainer.world_size)

    def _order(self) -> Shuffled:
        assert self._train is not None
        colons = sum(len(part) for part in self._train.datasets if isinstance(part, Rendered))
        frames = len(self._train) - colons
        if self.config.halves and frames and colons:
            return Halves(frames, colons, self.batch_size * self._place().world, self.config.seed)
        return Shuffled(len(self._train), self.config.seed)

    def train_dataloader(self) -> DataLoader[FrameBatch]:
        assert self._train is not None
        order, place = self._order(), self._place()
        if self._begun != (0, 0):
            epoch, batch = self._begun
            order.go_on(epoch, batch * self.batch_size * place.world)
        sampler = order if place.world == 1 else Parted(order, self.batch_size, place)
        full = len(sampler) >= self.batch_size  # one frame in a batch tells batch normalisation nothing
        return self._loader(self._train, "train", sampler, drop_last=full)

    def val_dataloader(self) -> DataLoader[FrameBatch]:
        assert self._val is not None
        return self._loader(self._val, "val")

    def on_after_batch_transfer(self, batch: FrameBatch, dataloader_idx: int) -> FrameBatch:
        if self.config.reflectance_error:
            batch = with_reflectance(batch, batch.light.reflectance + self.config.reflectance_error)
        trainer = self.trainer
        if trainer is None or not trainer.training:
            return batch
        place = Place(trainer.global_rank, trainer.world_size)
        generator = torch.Generator().manual_seed(self.config.seed * 1_000_003 + trainer.global_step)
        if self.config.augment:
            batch = augmented(batch, generator, place)
        if self.config.random_reflectance is not None:
            low, high = self.config.random_reflectance
            drawn = low + (high - low) * drawn_for(torch.rand, len(batch.image), generator, place)
            batch = with_reflectance(batch, drawn.reshape(-1, 1, 1, 1).to(batch.image.device))
        return batch

    def _loader(
        self, dataset: Dataset[FrameBatch], part: str, order: Sampler[int] | None = None, drop_last: bool = False
    ) -> DataLoader[FrameBatch]:
        left_out = partial(self._left_out, part)
        workers, replacing = self.config.num_workers, part == "train"  # an error counts once
        waited = self._waited if part == "train" else None
        return loader(dataset, self.batch_size, workers, left_out, order, drop_last, replacing, waited)

    def _left_out(self, part: str, error: InputError) -> None:
        said = self._unread[part]
        if error.where not in said:
            of = "training, with the next frame in its place" if part == "train" else "validation"
            said[error.where] = f"left out of {of}: {error}"
            self.tell(said[error.where])


def warn(sentence: str) -> None:
    warnings.warn(sentence, stacklevel=3)
