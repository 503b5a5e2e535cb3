"""`spackle train`: how the residual, or SHARP's own decoder, learns.

train             the loop, from top to bottom, and what it asks of a task    checkpoint  what a run resumes from
residual          the paper's method    direct_ft  its naive baseline         losses      eq. 12, as pure functions
sources           views with holes and truth                                  samples     what a step looks at
recipe, recipes/  what a run is made of, and the recipes that ship
"""
