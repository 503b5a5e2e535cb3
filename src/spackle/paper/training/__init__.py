"""`spackle train` trains the residual network (`residual`) or SHARP's decoder (`direct_ft`); read `train` first."""
