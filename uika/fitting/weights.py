"""Weights, scales and priors of the fits, in one place; each with what it stands for.

Landmark errors are measured in outer eye-corner distances, colours in grey levels of [0,1]. Robust scales are those of
Geman and McClure: errors beyond them lose influence.
"""

# Landmarks of photos and frames.
LANDMARK_NOISE = 0.02  # expected error of a landmark
PHOTO_ROBUST_SCALE = 0.04  # the identity is being fitted: an outlier would bend it
FRAME_ROBUST_SCALE = 0.08  # the identity is known: what is far off is mostly a quick movement that shall be followed
LANDMARK_FACING = 0.6  # cosine of the viewing angle from which a landmark has full trust
LANDMARK_HIDDEN_TRUST = 0.1  # trust of a landmark seen edge-on: the detector guesses there
LANDMARK_EXPRESSION_PRIOR = 2.0  # per squared activation
MARK_SHARE = 0.5  # weight of all surface marks of a photo over that of its landmarks: neighbours err alike
MARK_ROBUST_SCALE = 0.1  # what an estimator sees is rougher than a detector's landmarks, and at times far off

# Colours of surface points.
GREY_NOISE = 0.03  # expected error of a grey level
GREY_ROBUST_SCALE = 0.08
POINT_VISIBLE, POINT_FACING = 0.2, 0.7  # cosines of the viewing angle between which a surface point gains trust
GREY_EXPRESSION_PRIOR = 5.0  # per squared activation: colours see less of an expression than landmarks do

# Pixels of photos on their way into the atlas.
PIXEL_GRAZING, PIXEL_FACING = 0.08, 0.55  # cosines between which a pixel gains weight: grazing ones smear over texels
