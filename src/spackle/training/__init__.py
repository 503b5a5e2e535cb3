"""`spackle train`: how the residual, or SHARP's own decoder, learns.

train             the loop, and the interface of a task to train              checkpoint  what a run resumes from
residual          the paper's method    direct_ft  its naive baseline         losses      eq. 12, as pure functions
sources           where views with holes and their targets come from          samples     crops that a step learns from
recipe, recipes/  the settings of a run, and the recipes in the package
"""
