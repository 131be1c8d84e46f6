from .trainer import VLATrainer as VLATrainer
