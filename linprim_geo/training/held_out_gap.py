"""Detect overfitting: by how much held-out PSNR trails training PSNR, the likely cause, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable

from linprim_geo.base.options import TrainOptions

# Gap in dB between training and held-out views from which advice is given. 6 dB is twice the error in every colour,
# more than noise explains.
LARGEST_GAP = 6.0
# Below this number of training photographs, too few photographs is given as the cause: each covers too much of the
# scene alone.
FEW_VIEWS = 20
# Effects that explain a gap if they are needed (by the evidence) but off: the cause and the option that remedies it.
CAUSES = {
    "environment": (
        "what stands far behind the scene is explained by primitives before single cameras",
        "--background environment",
    ),
    "exposure": ("the photographs differ in exposure", "--exposure gain"),
}


def gap_advice(
    train_psnr: float, psnr: float, views: int, options: TrainOptions, decisions: Iterable[dict]
) -> str | None:
    """Return one sentence of advice if held-out views trail training views by more than LARGEST_GAP, else None.

    Args:
        train_psnr, psnr: mean PSNR in dB of training and of held-out views at the end of training.
        views: number of training views.
        decisions: decisions about effects as stored in config.json; effects without a measurement count as not needed.
    """
    if not train_psnr - psnr > LARGEST_GAP:
        return None
    begin = f"held-out views are {train_psnr - psnr:.1f} dB behind training views"
    off = {"environment": options.background != "environment", "exposure": options.exposure == "none"}
    for decision in decisions:
        name, value, threshold = decision.get("name"), decision.get("value"), decision.get("threshold")
        if name in CAUSES and off[name] and value is not None and threshold is not None and value >= threshold:
            cause, remedy = CAUSES[name]
            return f"{begin}: {cause}; train with {remedy}"
    if views < FEW_VIEWS:
        return f"{begin}: {views} photographs leave much of the scene to guesses; add photographs between them"
    return (
        f"{begin}: poses that are off, something that moved, or places that one photograph alone shows;"
        " look at the held-out views in the report, and leave out or mask what does not fit"
    )
