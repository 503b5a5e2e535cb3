"""`spackle bench`: what Spackle costs, in Gaussians and in time, on a dataset's images or stage by stage."""
