"""Small DICOM files made on the spot, with a name, dates and an institution in every place that may hold one."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from PIL import Image
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.encaps import encapsulate
from pydicom.pixels import get_encoder
from pydicom.uid import (
    MPEG4HP41,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGBaseline8Bit,
    RLELossless,
    generate_uid,
)

CANARY = "CANARYmueller"
_WHO = {
    "PatientName": f"{CANARY}^Hans",
    "PatientID": CANARY,
    "PatientBirthDate": "19500101",
    "OtherPatientNames": f"{CANARY}^X",
    "PatientAddress": CANARY,
    "PatientComments": CANARY,
    "InstitutionName": CANARY,
    "InstitutionAddress": CANARY,
    "ReferringPhysicianName": f"{CANARY}^Doc",
    "OperatorsName": f"{CANARY}^Op",
    "StudyDescription": CANARY,
    "SeriesDescription": CANARY,
    "StudyID": CANARY,
    "AccessionNumber": CANARY,
    "StationName": CANARY,
    "DeviceSerialNumber": CANARY,
    "ProtocolName": CANARY,
    "ImageComments": CANARY,
    "StudyDate": "20210304",
    "ContentDate": "20210304",
    "StudyTime": "050607",
    "AcquisitionDateTime": "20210304050607",
}
KINDS = {
    "native RGB": (ExplicitVRLittleEndian, "RGB"),
    "implicit, by planes": (ImplicitVRLittleEndian, "RGB"),
    "native YBR": (ExplicitVRLittleEndian, "YBR_FULL"),
    "native YBR 422": (ExplicitVRLittleEndian, "YBR_FULL_422"),
    "grey": (ExplicitVRLittleEndian, "MONOCHROME2"),
    "grey, white is 0": (ExplicitVRLittleEndian, "MONOCHROME1"),
    "grey of 12 bits": (ExplicitVRLittleEndian, "MONOCHROME2"),
    "RLE": (RLELossless, "RGB"),
    "JPEG": (JPEGBaseline8Bit, "YBR_FULL_422"),
    "JPEG in fragments": (JPEGBaseline8Bit, "YBR_FULL_422"),
    "JPEG 2000": (JPEG2000Lossless, "YBR_RCT"),
}


def write_dicom(path: Path, images: Sequence[np.ndarray], kind: str = "native RGB", **elements: Any) -> Path:
    """RGB images (H, W, 3) uint8 as a multi-frame file of one of KINDS, at 40 ms a frame; elements win."""
    syntax, colours = KINDS[kind]
    data = _described(images[0].shape[:2], syntax, colours, len(images))
    if colours.startswith("MONO"):
        greys = [np.rint(image.mean(-1)).astype(np.uint8) for image in images]
        if kind == "grey of 12 bits":
            data.BitsAllocated, data.BitsStored, data.HighBit = 16, 12, 11
            greys = [np.rint(image.mean(-1) / 255 * 4095).astype(np.uint16) for image in images]
        pixels = np.stack([255 - g for g in greys] if colours == "MONOCHROME1" else greys)
        data.PixelData = pixels.tobytes()
    elif kind == "implicit, by planes":
        data.PlanarConfiguration = 1
        data.PixelData = np.stack([image.transpose(2, 0, 1) for image in images]).tobytes()
    elif colours == "YBR_FULL" and syntax == ExplicitVRLittleEndian:
        data.PixelData = np.stack([_ybr(image) for image in images]).tobytes()
    elif kind == "native YBR 422":
        data.PixelData = b"".join(_halved(_ybr(image)) for image in images)
    elif syntax == ExplicitVRLittleEndian:
        data.PixelData = np.stack(images).tobytes()
    elif syntax == RLELossless:
        encode = get_encoder(RLELossless).encode
        frames = [encode(image.tobytes(), index=0, **_options(data)) for image in images]
        data.PixelData = encapsulate(frames)
    else:
        frames = [_compressed(image, "JPEG" if syntax == JPEGBaseline8Bit else "JPEG2000") for image in images]
        data.PixelData = encapsulate(
            frames, fragments_per_frame=3 if "fragments" in kind else 1, has_bot="2000" in kind
        )
    return _saved(data, path, elements)


def write_dicom_video(path: Path, video: Path, shape: tuple[int, int], count: int, **elements: Any) -> Path:
    """A video file as it is, in one item."""
    data = _described(shape, MPEG4HP41, "YBR_PARTIAL_420", count)
    data.PixelData = encapsulate([video.read_bytes()])
    return _saved(data, path, elements)


def _described(shape: tuple[int, int], syntax: str, colours: str, count: int) -> Dataset:
    data = Dataset()
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = syntax
    data.file_meta.MediaStorageSOPClassUID = data.SOPClassUID = "1.2.840.10008.5.1.4.1.1.77.1.1.1"
    data.file_meta.MediaStorageSOPInstanceUID = data.SOPInstanceUID = generate_uid()
    data.file_meta.SourceApplicationEntityTitle = CANARY
    for element, value in _WHO.items():
        setattr(data, element, value)
    inner = Dataset()
    inner.PatientName = f"{CANARY}^Inner"
    data.RequestAttributesSequence = [inner]
    data.private_block(0x0011, CANARY, create=True).add_new(1, "LO", CANARY)
    data.Rows, data.Columns, data.NumberOfFrames = *shape, count
    data.SamplesPerPixel = 1 if colours.startswith("MONO") else 3
    data.PhotometricInterpretation = colours
    if data.SamplesPerPixel == 3:
        data.PlanarConfiguration = 0
    data.BitsAllocated = data.BitsStored = 8
    data.HighBit, data.PixelRepresentation = 7, 0
    data.FrameTime = 40.0
    data.FrameIncrementPointer = pydicom.tag.Tag("FrameTime")
    return data


def _saved(data: Dataset, path: Path, elements: dict[str, Any]) -> Path:
    for element, value in elements.items():
        if value is None:
            delattr(data, element)
        else:
            setattr(data, element, value)
    data.save_as(path, enforce_file_format=True, implicit_vr=None if "TransferSyntaxUID" in data.file_meta else False)
    return path


def _options(data: Dataset) -> dict[str, Any]:
    return {
        "rows": data.Rows,
        "columns": data.Columns,
        "number_of_frames": 1,
        "samples_per_pixel": data.SamplesPerPixel,
        "bits_allocated": data.BitsAllocated,
        "bits_stored": data.BitsStored,
        "photometric_interpretation": data.PhotometricInterpretation,
        "pixel_representation": 0,
        "planar_configuration": 0,
    }


def _ybr(image: np.ndarray) -> np.ndarray:
    return np.asarray(Image.fromarray(image).convert("YCbCr"))


def _halved(ybr: np.ndarray) -> bytes:
    """Y Y Cb Cr of each two pixels of a row."""
    pairs = ybr.reshape(ybr.shape[0], -1, 2, 3)
    return np.stack([pairs[..., 0, 0], pairs[..., 1, 0], pairs[..., 0, 1], pairs[..., 0, 2]], -1).tobytes()


def _compressed(image: np.ndarray, kind: str) -> bytes:
    stream = io.BytesIO()
    options = {"quality": 95, "subsampling": "4:2:2"} if kind == "JPEG" else {"irreversible": False, "mct": 1}
    Image.fromarray(image).save(stream, kind, **options)
    return stream.getvalue()
