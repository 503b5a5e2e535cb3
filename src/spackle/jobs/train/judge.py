"""The loss of completed views, as a recipe has it."""

from __future__ import annotations

from spackle.jobs.train.plan import Place
from spackle.render import get_renderer
from spackle.training.features import load_features
from spackle.training.recipe import Recipe
from spackle.training.validation import Judge


def judge_of(place: Place[Recipe]) -> Judge:
    """The recipe's loss; InputError where its feature network cannot be read."""
    loss = place.recipe.loss
    features = load_features(loss.features if loss.perceptual else "none", loss.features_path, place.device)
    return Judge(loss, features, get_renderer(), place.precision, place.device)


def feature_name(judge: Judge) -> str:
    """What the perceptual term looks with, for run.json."""
    return judge.features.name if judge.features else "none"
