"""The generic text-motion evaluator of Guo et al. (CVPR 2022), which FID and R-Precision are measured by."""
