"""Networks, losses, quantizers, sampling and metrics; one small LightningModule per stage."""
