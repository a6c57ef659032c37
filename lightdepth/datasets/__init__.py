"""What is on disk, as frames: open_sequence(path) -> Sequence[Frame]. One module per format, each with its writer."""

from lightdepth.datasets.c3vd import read_c3vd, write_c3vd
from lightdepth.datasets.endomapper import read_endomapper, write_endomapper
from lightdepth.datasets.endoslam import read_endoslam, write_endoslam
from lightdepth.datasets.folder import read_folder, write_folder
from lightdepth.datasets.hamlyn import read_hamlyn, write_hamlyn
from lightdepth.datasets.reading import FORMATS, FormatName, open_sequence
from lightdepth.datasets.scared import read_scared
from lightdepth.datasets.scared_writing import write_scared
from lightdepth.datasets.sequence import FrameSequence
from lightdepth.datasets.simcol import read_simcol, write_simcol
from lightdepth.datasets.source import SequenceSource
from lightdepth.datasets.video import VideoFile
from lightdepth.datasets.video_sequence import read_video

__all__ = [
    "FORMATS",
    "FormatName",
    "FrameSequence",
    "SequenceSource",
    "VideoFile",
    "open_sequence",
    "read_c3vd",
    "read_endomapper",
    "read_endoslam",
    "read_folder",
    "read_hamlyn",
    "read_scared",
    "read_simcol",
    "read_video",
    "write_c3vd",
    "write_endomapper",
    "write_endoslam",
    "write_folder",
    "write_hamlyn",
    "write_scared",
    "write_simcol",
]
