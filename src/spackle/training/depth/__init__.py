"""Training the lite base: photos with depth, made and measured."""
