"""Training of the reconstructor and of the correspondence estimator."""

from uika.data.datasets import SYNTHETIC, Stored, Synthetic
from uika.model.estimator_file import load_estimator
from uika.train.config import TRAINING, LossWeights, TrainConfig
from uika.train.dataset import ItemMaker
from uika.train.item import Item
from uika.train.loop import MODEL_FILE, Setup, TrainingError, train
from uika.train.optimiser import batch_size, learning_rate
from uika.train.parallel import Group, join_group, leave_group
from uika.train.prepared import PreparedItems
from uika.train.sampler import Draw, Sampler, SamplerConfig

__all__ = [
    "MODEL_FILE",
    "SYNTHETIC",
    "TRAINING",
    "Draw",
    "Group",
    "Item",
    "ItemMaker",
    "LossWeights",
    "PreparedItems",
    "Sampler",
    "SamplerConfig",
    "Setup",
    "Stored",
    "Synthetic",
    "TrainConfig",
    "TrainingError",
    "batch_size",
    "join_group",
    "learning_rate",
    "leave_group",
    "load_estimator",
    "train",
]
