"""Say what physics a MuJoCo model leaves out, from recordings of the real robot.

python recipes/diagnose.py                    # demo: an arm that hides one effect; no data, a minute, 0.4 GB
python recipes/diagnose.py --dataset emps     # a public recording of a real bench
python recipes/diagnose.py --model robot.xml --recordings train/ --heldout heldout/ --output out/
python recipes/diagnose.py --uan              # and teach a net what no named physics explains: two minutes more

Files and folders are named one after the other. Ctrl-C leaves a report of what is known; the same command goes on.

The demo hides a torque lag of 22.33 ms at the elbow. Found: actuation_lag at the elbow, 22.0 ms, probability 98 %.
Over 0.5 s windows kept aside the error falls from 22.4 to 0.8 mrad, which is what the sensors' noise leaves.
--demo N hides another effect.
"""

import tyro

from torchrl_athletic.diagnosis.command import Config, main
from torchrl_athletic.training import learn_remainder

if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__), learn_remainder)
