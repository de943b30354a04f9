"""A baseline in one folder outside the package: motion paced by music, against a critic of its own.

`tests/pipeline/contract/test_new_stage.py` runs it. `MOTIONLOOM_STAGES=pacer.stage` names the module, and a
recipe says `kind: pacer`; nothing else knows of it.
"""
