"""What every table and figure shows, in the order of the thesis, and what the thesis reports where it gives a number.

Frames and numbers are those of the data at hand; where the thesis shows a certain frame that other data does not have,
the figure's own title says which one is shown instead.
"""

import json
from pathlib import Path

REPORTED = json.loads((Path(__file__).parent / "reported.json").read_text(encoding="utf-8"))

# The 36 figures and 5 tables: chapter, then name of the file: title, caption.
CHAPTERS = {
    "Chapter 2: background": {
        "figure_2_01": ("Basic CNN", "The stages of a convolutional network that classifies: convolution, activation, "
                        "pooling, dense layer, softmax. A diagram."),
        "figure_2_02": ("One convolution, in numbers", "A patch of an image, one kernel of the trained U-Net's first "
                        "layer, the feature map it gives, and what normalisation and activation leave of it. The "
                        "neighbourhood framed in red and the kernel give the value framed in red, which is printed."),
        "figure_2_03": ("Sigmoid and ReLU", "Both activation functions and their derivatives. The sigmoid's derivative "
                        "vanishes on both sides, which is what slows training; that of ReLU is a step: it is 1 for all "
                        "positive x."),
        "figure_2_04": ("Max pooling", "A 4x4 array under 2x2 max pooling with stride 2: of every block the largest "
                        "value is kept."),
        "figure_2_05": ("Dense layer and softmax", "A feature vector, weighted and summed for each class, becomes "
                        "scores; softmax turns them into probabilities that sum to one."),
        "figure_2_06": ("Stochastic gradient descent", "Steps down a loss surface with two valleys. Each follows a "
                        "gradient that is known only roughly, so the path trembles. It ends in the valley that "
                        "it comes to first, which need not be the deeper one: their losses are written beside them."),
        "figure_2_07": ("U-Net", "The network drawn from the Keras model itself, with two convolutions in a row in "
                        "each block as Section 2.1.6 has it: sizes and channels of every stage, the way down, the way "
                        "up, and the skip connections between them. In the thesis's code the second convolution "
                        "of a block starts at the block's input again, which leaves the first without effect."),
        "figure_2_08": ("Poses and relative motions", "Camera poses C of one sequence seen from above, with the "
                        "relative transforms T that lead from one to the next (Equations 2.2 and 2.3). Visual odometry "
                        "estimates each T and multiplies them."),
        "figure_2_09": ("ORB matches", "Keypoints found by ORB in two frames of one sequence and matched by their "
                        "descriptors; the closest matches are drawn, in the colour of their distance."),
        "figure_2_10": ("Drift", "An estimated path leaves the true one, and the distance between them along the "
                        "way: each step adds its own error to all later positions. Few keypoints make it "
                        "large enough to be seen."),
        "figure_2_11": ("Keypoints change with the viewpoint", "The same scene from two places: keypoints that are "
                        "found again, and those that are lost or new."),
        "figure_2_12": ("Keypoints on a frame and on its label map", "Shi-Tomasi on a frame covers every texture; on "
                        "the label map of that frame its points lie where classes meet. That those are fewer and "
                        "better is the idea of the thesis; the titles count them."),
    },
    "Chapter 3: method": {
        "table_3_1": ("Cityscapes categories", "Categories and label ids as the thesis lists them. There are 36, and "
                      "the network has 35 outputs."),
        "figure_3_01": ("Augmentation of an image", "An image as it is, flipped from left to right, shifted and "
                        "scaled, and blurred."),
        "figure_3_02": ("Augmentation of its label map", "The same transforms of the label map of Figure 3.1. Blur "
                        "changes no label."),
        "figure_3_03": ("Intersection over union", "A label map and a prediction of it for one class, what they share, "
                        "and what either of them covers; the IoU (Equation 3.1) is the ratio of the two areas."),
        "figure_3_04": ("Focal loss", "Focal loss against the probability that the network gives the true class, for "
                        "five values of γ (Equation 3.7). The larger γ, the less an easy pixel counts."),
        "figure_3_05": ("Pixels per category", "How often each category occurs in the label maps that the network is "
                        "trained on here. The scale is logarithmic."),
        "table_3_2": ("Class weights", "The weight of each category in the Dice loss, as the thesis lists them."),
        "figure_3_06": ("From a prediction to a mask", "A frame, its predicted label map, the edges that Canny finds "
                        "in the label map, and the edges dilated: keypoints are allowed where the mask is white."),
    },
    "Chapter 4: results": {
        "figure_4_01": ("Training and validation curves", "F1 score, IoU score and loss of every epoch, as the library "
                        "measures them: the mean over 35 classes in each batch, where a class that is neither "
                        "present nor predicted scores 1. This is not the mIoU of the Cityscapes benchmark."),
        "figure_4_02": ("Prediction on a validation image", "An image of the validation split, its label map, and the "
                        "network's prediction. The thesis calls the split its test images."),
        "figure_4_03": ("Prediction on an odometry frame", "A frame of the odometry data and its predicted label map, "
                        "below them the true one where the data has it. "
                        "The thesis shows sequence 10, frame 192; the title says which frame this is."),
        "figure_4_04": ("Keypoints along predicted boundaries", "The edges of the predicted label map, and the "
                        "keypoints that the mask around them leaves, on the frame made brighter."),
        "figure_4_05": ("The procedure", "Frame, all Shi-Tomasi keypoints, prediction, dilated edges, and the "
                        "keypoints that are kept. The thesis shows sequence 10, frame 637; the title says which "
                        "frame this is."),
        "figure_4_06": ("Paths with all keypoints", "Estimated against true path of every sequence, seen from above, "
                        "without masks."),
        "figure_4_07": ("Keypoints kept", "The part of the keypoints that masks of increasing dilation width leave, "
                        "one line a sequence."),
        "figure_4_08": ("Keypoints that jump", "One object in consecutive frames: the predicted boundary moves, and "
                        "the keypoints along it with it. The thesis sees in this a cause of its errors. Picked is the "
                        "object from which most keypoints jump from the first of these frames to the second. Rings "
                        "are the keypoints of the frame before as far as Lucas-Kanade could follow them and they are "
                        "still in the picture, so there may be fewer than that frame has."),
        "figure_4_09": ("RMSE against dilation width", "Root mean square distance from the true path (Equation 3.5) "
                        "where both paths are laid over each other at frame 1, frame 0 left out; one line a "
                        "sequence. Below, one panel a sequence with the bands from the lowest to the highest of the "
                        "repetitions, with masks and with all keypoints."),
        "figure_4_10": ("MAE against dilation width", "Mean absolute error (Equation 3.6), measured and drawn as in "
                        "Figure 4.9."),
        "table_4_1": ("Best dilation width", "The width with the lowest RMSE on each sequence (the thesis says RMSE "
                      "and/or MAE), and the mean number of keypoints that it leaves. The width is chosen on the "
                      "sequence that it is judged on."),
        "figure_4_11": ("Paths with each sequence's best width", "Estimated against true paths with the masks of Table "
                        "4.1."),
        "figure_4_12": ("Paths with plainly fewer keypoints", "No masks: the detector is limited to the mean number of "
                        "keypoints of Table 4.1."),
        "figure_4_13": ("RMSE of the three methods", "All keypoints, masks of the best width, and plainly fewer "
                        "keypoints, every sequence: mean of the repetitions, and the range that they span."),
        "figure_4_14": ("RMSE of each sequence", "The errors of Figure 4.13, one panel a sequence with its own scale."),
        "figure_4_15": ("MAE of the three methods", "As Figure 4.13, for the mean absolute error."),
        "figure_4_16": ("MAE of each sequence", "As Figure 4.14, for the mean absolute error."),
        "table_4_2": ("Change of RMSE", "Percent change from all keypoints (Equation 4.1; negative is better) with "
                      "each sequence's best width, beside it what aligned ATE and the errors over short stretches, "
                      "which no constant angle between camera and truth moves, say of that width, and what fairer "
                      "choices of width and the controls give. The "
                      "thesis's aggregate is the sum of the percentages; mean, its interval and median are below it. "
                      "Intervals of chosen widths are too narrow: the choices share most of their data."),
        "table_4_3": ("Change of MAE", "As Table 4.2, for the mean absolute error alone."),
        "figure_4_17": ("Time saved", "Change of the time for each dilation width (Equation 4.2; negative is time "
                        "saved), added up over the first frames of every sequence, which alone are timed; dots are "
                        "single sequences. The thesis "
                        "adds up whole sequences. Masks are counted, the network that predicts the label maps is "
                        "not, as in the thesis; the budget below counts everything. Figures in the repository "
                        "keep the timings that came with them; a machine's own are in notebook 8."),
    },
    "Appendix": {
        "figure_a_01": ("Model summary", "Every layer of the thesis's network at its full size, 320x320 with 64 "
                        "filters in the first block, as built here, with the number of parameters below."),
    },
}

# What depends on label maps, so that their quality stands beside it.
ON_LABEL_MAPS = {*(f"figure_4_{number:02d}" for number in (3, 4, 5, *range(7, 18))), "table_4_1", "table_4_2",
                 "table_4_3", "widths", "controls"}


# What shows a network being trained, or set against label maps: left out where the model in the package is used.
OF_TRAINING = {"table_3_1", "table_3_2", "figure_4_01", "figure_4_02",
               *(f"figure_3_{number:02d}" for number in range(1, 6))}
CARD = "thesis_repro/segmentation/weights/README.md"  # of the model in the package

# What is not in the thesis: (kind, name of the file), title, caption.
ADDED = {
    ("text", "findings"): ("What the runs show", ""),
    ("text", "answer_in_words"): ("The answer, in words", ""),
    ("figure", "answer"): ("Error against number of keypoints", "How many times the error of all keypoints each method "
                           "has, at as many keypoints as it leaves: markers are geometric means over sequences at the "
                           "tested width, bars their intervals, lines lead through other widths and limits. Above, the "
                           "thesis's estimator, below, the refined one, by which the question is judged; both scales "
                           "are logarithmic."),
    ("figure", "answer_sequences"): ("Error against number of keypoints, each sequence", "RMSE under the refined "
                                     "estimator without the constant angle between camera and truth; bars go from the "
                                     "lowest to the highest of the repetitions."),
    ("table", "answer"): ("The answer, in numbers", "Geometric means over sequences of the ratios of errors within "
                          "each sequence, with bootstrap intervals; one that holds 1 shows no difference. The mean of "
                          "percentages, as the thesis takes it, stands beside them."),
    ("figure", "domain_gap"): ("The gap between domains", "IoU of each class (Cityscapes' measure, over the whole set) "
                               "of the run's model and of the model in the package: on validation images of the run's "
                               "training data, on the odometry's own frames where these have exact label maps, and on "
                               "KITTI's street scenes where KITTI_SEMANTIC names them. The model in the package was "
                               "trained on CamVid, on some of those scenes and on images of the embedded world; its "
                               "card says on which."),
    ("table", "domain_gap"): (
        "The gap between domains, in numbers",
        "Each model at its own size. A boundary is found where a predicted one lies within 2 pixels of 320; by "
        "chance says how much of the image lies so near to a predicted boundary. Dark is ground (road, sidewalk, "
        "terrain by the true label map) whose gray is below 0.6 times the median of its class in its image, lit is "
        "the rest of it; both leave out what lies within 4 pixels of a true boundary. Flicker is the share of "
        "pixels whose class changes between consecutive frames of the odometry after the motion has been taken "
        "out; exact label maps show the floor of that measure."),
    ("table", "widths"): ("A fair choice of width", "The thesis's best width of each sequence beside one width for all "
                          "and the width that the other sequences choose, as changes in percent from all keypoints; "
                          "and how far the best width is chance. The intervals of chosen widths are too narrow: the "
                          "choices share most of their data."),
    ("figure", "masks"): ("Masks, corrected", "The thesis's mask of one frame beside masks with one correction each, "
                          "and with all of them: what is kept is light, with the keypoints on it; true boundaries are "
                          "orange where the data has true label maps."),
    ("table", "masks"): ("Masks, in numbers", "For the thesis's masks and for each correction: the share of the true "
                         "boundary pixels that the mask keeps, of the predicted label maps and of the true ones, the "
                         "part of the frame that it covers, and the keypoints on it; means over frames of the "
                         "sequence. Blank where the data has no true label maps."),
    ("figure", "controls"): ("Controls", "Masks from the segmentation against masks and limits that know nothing of "
                             "it, under the thesis's estimator and under the refined one. If a control does as well, "
                             "it is not the segmentation that helps. Where changes are large, the axis follows the "
                             "logarithm of the ratio of the errors: four times is as far from 0 as a quarter."),
    ("table", "controls"): ("Controls, in numbers", "Mean changes in percent from all keypoints under the same "
                            "estimator, and what masks do better (negative) or worse than each control."),
    ("figure", "budget"): ("Time of a frame, whole", "What one frame costs from reading it to its pose, the network "
                           "included, against the ten frames a second that KITTI's camera takes."),
    ("table", "budget"): ("Time of a frame, in numbers", "Milliseconds of each stage, and the frames a second that "
                          "they allow one after another and with the next frame segmented meanwhile."),
    ("table", "audit"): ("Audit", "Where the thesis contradicts itself, its code or its libraries, and claims that no "
                         "table of it shows: what would be right, the switch that makes it so, and what that switch "
                         "alone does here. Ratios are geometric means over sequences, spreads their intervals, or the "
                         "range where there are fewer than three."),
}

# What a study with masks of one's own shows: (kind, name of the file), title, caption. NAME is that of a source.
STUDY = {
    ("text", "findings"): ("What the runs show", ""),
    ("table", "sources"): ("The masks side by side", "Mean changes in percent from all keypoints under the same "
                           "estimator (Equation 4.1; negative is better), every source of masks and width."),
    ("figure", "keypoints-thesis"): ("Error against keypoints, thesis's estimator", "Above, the mean change of RMSE over "
                                  "the sequences and its interval against the part of the keypoints that the masks "
                                  "leave, one line a source. Below, each sequence by itself; bars go from the lowest "
                                  "to the highest repetition, the diamond is all keypoints."),
    ("figure", "keypoints-refined"): ("Error against keypoints, refined estimator", "As before, where RANSAC's inliers "
                                      "alone decide and the motion is fitted to them."),
    ("figure", "controls-NAME"): ("Controls of NAME", "These masks against masks and limits that know nothing of the "
                                  "segmentation. If a control does as well, it is not the segmentation that helps."),
    ("table", "controls-NAME"): ("Controls of NAME, in numbers", ADDED["table", "controls"][1]),
    ("table", "widths-NAME"): ("A fair choice of width for NAME", ADDED["table", "widths"][1]),
    ("table", "errors"): ("Every sequence", "RMSE and MAE in metres, means over the repetitions and their range, and "
                          "changes in percent from all keypoints; aligned ATE and the errors over short stretches, "
                          "which no constant angle between camera and truth moves, stand beside them."),
}

_FACTORS = [2000 / row["mean_keypoints"] for row in REPORTED["table_4_1"]]
_SCORES = "; ".join(f"{name} loss {scores['loss']}, F1 {scores['f1']}, IoU {scores['iou']}"
                    for name, scores in REPORTED["segmentation_results"].items())

# Numbers that the thesis reports and no table here has beside its own. Those of "runs" come from the complete KITTI
# sequences, those of "training" from Cityscapes; those of "model" depend on no data.
REPORTS = {
    "figure_4_01": ("training", f"{REPORTED['training']['epochs_run']} epochs, the best was "
                    f"{REPORTED['training']['best_epoch']}; {_SCORES}."),
    "figure_4_07": ("runs", "fewer keypoints by a factor of {} to {}; its Table 4.1 gives {:.1f} to {:.1f} times "
                    "fewer than 2000.".format(*REPORTED["headline_claims"]["keypoint_reduction_factor"],
                                              min(_FACTORS), max(_FACTORS))),
    "figure_4_17": ("runs", "{} to {} % of the time saved.".format(
        *REPORTED["headline_claims"]["time_savings_percent"])),
    "figure_a_01": ("model", f"{REPORTED['figure_a1_model_summary']['total']:,} parameters."),
}
