"""The earlier place of :mod:`fb3d_rl.kinematics.validation`, which scripts of others import it from."""

from fb3d_rl.kinematics.validation import examine as examine
