"""`spackle train`: how the residual, or SHARP's own decoder, learns.

train            the loop, from top to bottom (checkpoint: what it resumes from; ranks: several processes)
task             what the loop sees of what learns: batches in, losses out
residual         the paper's method            direct_ft   its naive baseline
losses           eq. 6, as pure functions      features    the frozen networks of the perceptual term
sources          views with holes and truth    composites  photos without depth made into scenes
sample, data     what a step looks at, and its files
recipe, recipes/ what a run is made of, and the recipes that ship
"""
