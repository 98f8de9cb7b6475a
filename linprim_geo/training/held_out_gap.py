"""Overfitting: how far held-out photographs stay behind training photographs, the likely cause, and what to do."""

from __future__ import annotations

from collections.abc import Iterable

from linprim_geo.base.options import TrainOptions

# Held-out views this far behind training views, in dB, are no matter of noise: twice the error in every colour.
LARGEST_GAP = 6.0
# With fewer photographs than this each stands for too much of a scene.
FEW_VIEWS = 20
# Effects whose evidence explains a gap where they are needed and off: the cause and the option.
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
    """One sentence for people where held-out views stay more than LARGEST_GAP behind training views, else None.

    Args:
        train_psnr, psnr: mean PSNR in dB of training and of held-out views at the end of a training.
        views: training views.
        decisions: what was decided about effects, as config.json has it; those not measured count as not needed.
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
