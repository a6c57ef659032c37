"""From findings to a verdict: the thresholds, and the words."""

from __future__ import annotations

from dataclasses import dataclass

from lightdepth.detective.cameras import OtherCamera
from lightdepth.detective.colours import Colours
from lightdepth.detective.evidence import CLEAR, LEAST_POINTS, Fit
from lightdepth.detective.geometry import Geometry
from lightdepth.detective.readings import Reading
from lightdepth.detective.verdict import Judgement, Verdict
from lightdepth.maps.checks import MAX_MEDIAN_PX

_CHANCE = 0.62  # share told from chance, up to which nothing fits; readings right but for 2 px of noise have .79
_HARDLY = 0.72
_ELSEWHERE = 0.34  # of the keyframes, in which frames far away may fit better
_COIN = 0.45
_MANY_STRANGE, _SOME_STRANGE = 0.45, 0.3  # of the keyframes: right ones with 2 px of noise have up to .27
_SURELY = 0.75  # NCC, below which a reading that fits better may only be the luck of another clip
_READS = 0.6  # NCC, from which a map that cannot be seen as it is given is right when read otherwise
_OTHER_CAMERA = 1.5  # times the residual under the map's own, from which the user's camera is doubted
_TRUST = "or --trust-map to go on as it is"


@dataclass(frozen=True)
class Findings:
    """All that was found of one submap."""

    submap: int
    geometry: Geometry | None
    at_hand: Fit | None = None
    points: int = 0
    """sightings that both images show with contrast"""
    from_chance: float = 0.5
    strange: tuple[str, ...] = ()
    """keyframes that are no more like the others than frames far away from them"""
    tried: tuple[tuple[Reading, Fit], ...] = ()
    elsewhere: tuple[Fit, ...] = ()
    """frames far away, which the map cannot be of"""
    colours: Colours | None = None
    other_camera: OtherCamera | None = None
    """the frames' own camera, or the one that the user gave, beside the map's"""


def judged(found: Findings) -> Verdict:
    """The verdict; images first, as they know most."""
    judgement, sentence, cure = _with_camera(found, *_with_colours(found, *_said(found)))
    fits = (*(fit for _, fit in found.tried), *found.elsewhere)
    untold = _untold(found)
    if judgement == "agrees" and untold:
        sentence += f"; it could not tell whether {' or '.join(untold)}"
    return Verdict(
        judgement,
        sentence,
        cure,
        found.at_hand,
        fits,
        found.from_chance if found.points else None,
        found.geometry,
        untold,
        found.submap,
        found.colours,
        found.other_camera,
    )


def _with_camera(found: Findings, judgement: Judgement, sentence: str, cure: str) -> tuple[Judgement, str, str]:
    """What a second camera adds to what else was said: keypoints judge one that was given, where there are any."""
    other = found.other_camera
    if other is None or not other.differs or judgement == "wrong" or (other.given and found.geometry is not None):
        return judgement, sentence, cure
    apart = f"{other.pixels:.1f} px (median) from where the map's does" if other.pixels < 1e6 else "out of its view"
    if other.given:
        said = f"the given camera puts the map's points {apart}"
        if other.pixels > MAX_MEDIAN_PX:
            return "wrong", said, f"leave --camera out, {_TRUST}"
        return "doubtful", said, cure or "leave --camera out"
    said = f"the frames' own camera puts the map's points {apart}; the map's is used"
    own = (
        "if the map's is right, put it in place of the frames' own; if theirs is, make the map anew with it "
        "(lightdepth sparse)"
    )
    return "doubtful", f"{sentence}; {said}" if judgement == "doubtful" else said, cure or own


def _with_colours(found: Findings, judgement: Judgement, sentence: str, cure: str) -> tuple[Judgement, str, str]:
    """What the points' colours add to what else was said. A reading that they name is refused, but for patches that
    deny it; other colours alone are a doubt, and none where patches agree: they need not be those of images."""
    colours = found.colours
    if colours is None or judgement == "wrong":
        return judgement, sentence, cure
    best, own = colours.best, colours.at_hand
    if best is not None:
        reading, fit = best
        said = (
            f"points and images agree by {own.likeness:.2f} in the order of their colours, but by {fit.likeness:.2f} "
        )
        said += f"(better in {fit.better:.0%} of {fit.keyframes} keyframes) if {reading.name}"
        by_patches = next((other for tried, other in found.tried if tried.name == reading.name), None)
        if by_patches is not None and by_patches.loses:
            return "doubtful", f"{sentence}; but {said}", cure or reading.cure
        return "wrong", said, f"{reading.cure}, {_TRUST}"
    surely = found.at_hand is not None and found.points >= LEAST_POINTS and found.at_hand.likeness >= _SURELY
    if judgement == "doubtful":
        return judgement, sentence, cure
    if colours.unlike and not surely:
        said = f"points and images agree by {own.likeness:.2f} in the order of their colours, where 0 is chance"
        return "doubtful", f"{sentence}; {said}", "are these the frames that the map and its colours were made of?"
    if judgement == "cannot tell" and colours.alike:
        said = (
            f"points and images agree by {own.likeness:.2f} in the order of their colours ({own.keyframes} keyframes)"
        )
        return "agrees", f"frames and map agree: {said}, and no other reading fits better (patches cannot tell)", ""
    return judgement, sentence, cure


def _said(found: Findings) -> tuple[Judgement, str, str]:
    geometry, at_hand = found.geometry, found.at_hand
    of_geometry = None if geometry is None else _geometry(geometry)
    if of_geometry is not None and of_geometry[0] == "wrong":
        return of_geometry
    otherwise = max(found.tried, key=lambda tried: tried[1].likeness, default=None)
    if at_hand is None and otherwise is not None and otherwise[1].likeness >= _READS:
        said = f"as it is given no keyframes see the same points, but {_alike(otherwise[1].likeness)} if "
        return "wrong", said + otherwise[0].name, f"{otherwise[0].cure}, {_TRUST}"
    if at_hand is None or found.points < LEAST_POINTS or at_hand.keyframes < 2:
        if of_geometry is not None:
            return of_geometry
        said = "no two keyframes share enough points with images" if at_hand is None else _few(found)
        return "cannot tell", f"the images cannot tell whether they are the map's: {said}", ""
    alike = _alike(at_hand.likeness)
    best = _best(found, "wins")
    if best is not None:
        reading, fit = best
        sure = "" if fit.likeness >= _SURELY else " (if these are the frames that the map was made from)"
        return "wrong", f"{alike}, but {_figures(fit)} if {reading.name}", f"{reading.cure}{sure}, {_TRUST}"
    if found.from_chance < _CHANCE:
        said = f"{alike}, no more than patches around different points ({found.from_chance:.0%} of pairs are told)"
        return "wrong", said, f"are these the frames that the map was made from? Give those, {_TRUST}"
    away = max(found.elsewhere, key=lambda fit: fit.better, default=None)
    far = "" if away is None else f"{alike}, and {_figures(away)} in frames far away from those that they are taken for"
    if away is not None and away.better >= _COIN:
        return "wrong", far, f"are these the frames that the map was made from? Give those, {_TRUST}"
    strange, share = found.strange, len(found.strange) / at_hand.keyframes
    odd = f"{alike}, but {len(strange)} of {at_hand.keyframes} keyframes ({', '.join(strange[:4])}) are no more like "
    odd += "each other than frames far away from them"
    if share >= _MANY_STRANGE:
        return "wrong", odd, f"do all keyframes belong to these frames? Give those that the map was made from, {_TRUST}"
    rival = _best(found, "rivals")
    if rival is not None:
        return "doubtful", f"{alike}, and {_figures(rival[1])} if {rival[0].name}", rival[0].cure
    if away is not None and away.better > _ELSEWHERE:
        return "doubtful", far, "are these the frames that the map was made from?"
    if share >= _SOME_STRANGE:
        return "doubtful", odd, "do all keyframes belong to these frames?"
    if found.from_chance < _HARDLY:
        said = f"{alike}, little more than patches around different points ({found.from_chance:.0%} of pairs are told)"
        return "doubtful", said, "are these the frames that the map was made from?"
    if of_geometry is not None:
        return of_geometry
    return "agrees", f"frames and map agree: {alike}, and no other reading fits better", ""


def _alike(likeness: float) -> str:
    return f"patches around one map point have an NCC of {likeness:.2f} in two keyframes"


def _few(found: Findings) -> str:
    return f"{found.points} patches have contrast, of at least {LEAST_POINTS} in 2 keyframes that are needed"


def _best(found: Findings, how: str) -> tuple[Reading, Fit] | None:
    assert found.at_hand is not None
    enough = found.at_hand.keyframes / 2  # what fits in a few alone may do so by chance
    able = [(reading, fit) for reading, fit in found.tried if getattr(fit, how) and fit.keyframes >= enough]
    return max(able, key=lambda tried: round(tried[1].gain, 2), default=None)


def _figures(fit: Fit) -> str:
    by_corners = fit.corners is not None and fit.gain < CLEAR / 2 < fit.corners.gain
    how = "keypoints nearer to corners" if by_corners else "better"
    better = fit.corners.better if by_corners and fit.corners is not None else fit.better
    return f"{fit.likeness:.2f} ({how} in {better:.0%} of {fit.keyframes} keyframes)"


def _geometry(found: Geometry) -> tuple[Judgement, str, str] | None:
    """What keypoints say against the reading; None where they have nothing to say against it."""
    if found.given is not None and found.given > _OTHER_CAMERA * found.residual + 1:
        said = f"keypoints are {found.given:.1f} px from their points under the given camera, {found.residual:.1f} px "
        said += "under the map's own"
        judgement: Judgement = "wrong" if found.given > MAX_MEDIAN_PX else "doubtful"
        return judgement, said, f"leave --camera out, {_TRUST}" if judgement == "wrong" else "leave --camera out"
    if found.half_a_pixel < found.residual and found.tells_half_a_pixel:
        said = f"keypoints are {found.residual:.2f} px from their points, {found.half_a_pixel:.2f} px if the keypoints "
        return "doubtful", f"{said}are half a pixel off", "count pixels alike in keypoints and camera"
    if found.residual > MAX_MEDIAN_PX:
        said = f"keypoints are {found.residual:.1f} px from their points, of which about 1 is expected"
        return "doubtful", said, "check that cameras, images and points belong together"
    if found.apart:
        said = f"keypoints of {len(found.apart)} keyframes ({', '.join(found.apart[:4])}) are far from their points"
        return "doubtful", f"{said}, those of the others {found.residual:.1f} px", "are their poses right?"
    return None


def _untold(found: Findings) -> tuple[str, ...]:
    """Readings that fit about as well as the one at hand."""
    tried = [(reading, fit) for reading, fit in found.tried if reading.counting.rate == 1]
    denied = set() if found.colours is None else found.colours.denied()
    alike = [reading.name for reading, fit in tried if not (fit.loses or fit.wins or fit.rivals)]
    alike = [name for name in alike if name not in denied]
    if found.geometry is None or not found.geometry.tells_half_a_pixel:
        alike.append("keypoints are half a pixel off")
    return tuple(alike)
