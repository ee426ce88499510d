"""Print what mrcal says of a camera that it has calibrated, as JSON.

    /usr/bin/python3 benchmarks/mrcal_figures.py camera-0.cameramodel pixels.npy

For the Python that has mrcal, which is the system's: nothing of jaxnav is imported. `pixels.npy` is
(N, 2); how unsure mrcal is of the projection there, far away, is the square root of half the trace
of its covariance.
"""

import json
import sys

import mrcal
import numpy as np

model = mrcal.cameramodel(sys.argv[1])
rays = mrcal.unproject(np.load(sys.argv[2]), *model.intrinsics(), normalize=True)
inputs = model.optimization_inputs()
residuals_px = mrcal.residuals_chessboard(inputs)
# No row of mrcal's own Jacobian is counted but the corners': its regularization is no measurement.
_, _, J, factorization = mrcal.optimizer_callback(**inputs)
corners = mrcal.num_measurements_boards(**inputs)
state = mrcal.num_states(**inputs)
rows = np.zeros((2, state))
rows[0, 0] = rows[1, 1] = 1.0
mrcal.unpack_state(rows, **inputs)  # d(fx, fy) / d(packed state)
solved = factorization.solve_xt_JtJ_bt(np.ascontiguousarray(rows))
spread = J[:corners].toarray() @ solved.T
noise_px = float(np.std(residuals_px))
json.dump(
    {
        "parameters": model.intrinsics()[1].tolist(),
        "focal_sigma_px": (noise_px * np.sqrt(np.sum(spread**2, axis=0))).tolist(),
        "sigma_px": mrcal.projection_uncertainty(
            rays, model, atinfinity=True, what="rms-stdev"
        ).tolist(),
    },
    sys.stdout,
)
