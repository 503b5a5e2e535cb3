"""`spackle train`: how the residual, or SHARP's own decoder, learns.

run              the command: a recipe to weights, new or resumed
recipe, recipes/ what a run is made of, and the recipes that ship
trainer          the loop: items in, weights out (checkpoint: what it resumes from; ranks: several processes)
method           what the trainer sees of a network's task; the objective and validation of completed views
residual_method  the paper's method            direct_ft   its naive baseline
losses           eq. 6, as pure functions      features    the frozen networks that the perceptual term looks with
sources          views with holes and truth    composites  photos without depth made into scenes
sample, data     what a step looks at, and its files
"""
