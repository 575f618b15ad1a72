"""What a keypoint is worth: how much one of a choice tells about a step's motion. No ground truth.

Statistics calls it the relative efficiency of a choice: a ratio of variances at an equal number of
observations, here estimated from random half-samples (split-half, in the theory of tests). If n
keypoints give a motion with the variance V / n, two disjoint halves of n1 and n2 of them give
motions that differ by an angle of variance V (1 / n1 + 1 / n2).

The rule, fixed before the runs that the tables show:

1. **Measure.** The variance of one keypoint is the median over steps and splits of angle^2 n1 n2 /
   (n1 + n2). The angle is the one between the rotations, or the directions of translation, of both
   halves. The worth is this variance of as many random keypoints (drawn from all keypoints of the
   same frame) divided by that of the choice. So random keypoints have 1, and a keypoint of worth
   1/2 tells half as much: twice as many of them give the same precision.
2. **Motion.** RANSAC and the refined fit of each half alone, without the comparison with the step
   before, so that the halves share nothing but the step. A half without a motion counts with 180
   degrees. Keypoints that the tracker loses count in n1 and n2: they tell nothing.
3. **Steps** of at least 0.25 m, as for all directions (`metrics.MIN_DIRECTED_STEP`); all steps of a
   sequence without lengths.
4. **Numbers.** 400 keypoints decide, drawn at random from the choice unless it chooses how many
   itself (spread, strongest); 100, 200 and all of a choice stand beside. A choice that has fewer is
   compared with as few random ones. Masks have the width 10.
5. **Splits.** Three of each of two kinds, with new draws, seed 0. *Fields*: fields of the frame of
   42 pixels, two windows of the tracker, from a random corner on, go into one half as a whole.
   *Points*: each keypoint for itself. What neighbours share (pixels, a wrongly drawn boundary) is
   in both halves of a split by points, which cannot see it: a keypoint and its copy have a worth of
   1 there and of 1/2 by fields (seen in a simulated scene before this was written). But fields can
   underrate a choice that lies in few of them, because its halves are less alike. So the number
   that is told is that of fields, and a verdict needs both.
6. **Units** are streets: one worth a street, their typical value and its interval by
   `compare.typical_interval` of logarithms. Shuffles, splits and steps are no units.
7. **Verdict.** "less" or "more": the whole 95 % interval is on this side of 1 for rotation and
   direction, by fields and by points. "as much": all four 90 % intervals lie within 0.8 to 1.25.
   Otherwise "no clear difference". Fewer than six streets are too few to tell.
8. **Check.** A second, independent draw of random keypoints is a choice like all others (`random`).
   If a 95 % interval of it excludes 1, the measure is wrong and says nothing.
9. **One standard for all choices.** Beside the worth: the streets on which a choice fails, the
   aligned ATE and the rotation error against all keypoints, with both estimators, with and without
   street 01, and rule 5 of few keypoints (no worse) for every choice, with failures counted as
   streets.

Known before: a prototype on eleven streets, eight of which are those at hand, with splits by points
(direction and rotation): random 1.02, 1.01; spread 1.46, 1.24; strongest 0.96, 0.96; exact
boundaries 0.77, 1.02; the thesis's mask 0.51, 0.65. So the result by points is no surprise; that by
fields was not known.

Limits: both halves share a bias of the whole step (calibration, a rolling shutter, a moving crowd),
which only the error against a ground truth shows. The worth holds for its number: the more
keypoints there are, the more of what they tell they share.
"""
