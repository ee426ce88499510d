"""Files of persons and of other tools that are read without an objection."""

import json

KALIBR = """
cam0:
  camera_model: pinhole
  distortion_model: equi
  distortion_coeffs: [-0.01, 0, 0.01, 0]
  intrinsics: [470, 471.5, 639.7, 524.4]
  resolution: [1280, 1024]
  T_cam_imu: [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]]
cam1:
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: [0.1, -0.02, 0.001, 0.002]
  intrinsics: [400.0, 401.0, 320.0, 240.0]
  resolution: [640, 480]
  T_cn_cnm1: [[0, 0, 1, 0.5], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]
"""
SPHERES = """
cam0:
  camera_model: omni
  distortion_model: radtan
  distortion_coeffs: [-0.1, 0.02, 0.001, 0.002]
  intrinsics: [1.5, 1200, 1201.5, 639.7, 524.4]
  resolution: [1280, 1024]
cam1:
  camera_model: ds
  intrinsics: [-0.2, 0.6, 380, 381.5, 639.7, 524.4]
  resolution: [1280, 1024]
cam2:
  camera_model: eucm
  intrinsics: [0.6, 1.1, 470, 471.5, 639.7, 524.4]
  resolution: [1280, 1024]
"""
CAMERA_INFO = """
image_width: 640
image_height: 480
camera_name: narrow
camera_matrix: {rows: 3, cols: 3, data: [400.5, 0.0, 320.0, 0.0, 401.0, 240.0, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.02, 0.001, 0.002, 0.003]}
"""
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 4.0e+02, 0., 3.2e+02, 0., 4.01e+02, 2.4e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 1.0e-01, -2.0e-02, 1.0e-03, 2.0e-03, 0. ]
"""
PHOTONVISION = """{"resolution": {"width": 640.0, "height": 480.0},
"cameraIntrinsics": {"rows": 3, "cols": 3, "type": 6, "data": [400, 0, 320, 0, 401, 240, 0, 0, 1]},
"distCoeffs": {"rows": 1, "cols": 5, "type": 6, "data": [0.1, -0.02, 0.001, 0.002, 0.0]},
"lensmodel": "LENSMODEL_OPENCV", "observations": []}
"""
WPILIB = """{"tags": [
{"ID": 1, "pose": {"translation": {"x": 15.079472, "y": 0.245872, "z": 1.355852},
"rotation": {"quaternion": {"W": 0.5, "X": 0.0, "Y": 0.0, "Z": 0.8660254037844386}}}},
{"ID": 7, "pose": {"translation": {"x": -0.0381, "y": 5.547868, "z": 1.451102},
"rotation": {"quaternion": {"W": 1.0, "X": 0.0, "Y": 0.0, "Z": 0.0}}}}
], "field": {"length": 16.541, "width": 8.211}}
"""
AMBIGUITY = """
trials: 50
seed: 3
precision: float64
axes:
  cameras: [1, 2]
  corner_noise_px: {from: 0.1, to: 3, count: 9, scale: log}
  selector: [lowest-reprojection, mahalanobis]
fixed: {range_m: 2.5, view_angle_deg: 30}
rig: qcar
"""
DRIVE = """
trials: 20
axes:
  corner_noise_px: [0.3, 1]
fixed: {selector: paper-cost}
"""
TAGSLAM = {
    "cameras.yaml": """
cam0:
  camera_model: pinhole
  intrinsics: [400, 400, 320, 240]
  distortion_model: equidistant
  distortion_coeffs: [0, 0, 0, 0]
  resolution: [640, 480]
  tagtopic: /a/tags
  rig_body: cart
""",
    "tagslam.yaml": """
default_body: wall
bodies:
 - wall:
     is_static: true
     default_tag_size: 0.5
     pose: {position: {x: 1, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 1.5707963267948966}}
     tags:
       - {id: 3, size: 0.25, pose: {position: {x: 2, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0}}}
       - {id: 4}
 - cart: {is_static: false, odom_delay_s: 0.1, odom_sigma: {scale: 0.05, turn_deg: 2}}
""",
    "camera_poses.yaml": """
cam0: {pose: {position: {x: 0.1, y: 0, z: 0}, rotation: {x: 0, y: 3.141592653589793, z: 0}}}
""",
}
PARAMETERS = {
    "motion.odometry_sigma": [[1e-4, 5e-5, 0.0], [5e-5, 1e-4, 0.0], [0.0, 0.0, 4e-4]],
    "motion.acceleration_density": [0.02, 0.01, 0.09],
    "controller.proportional_per_m": 0.05,
}
PARAMS = f"""
parameters: {json.dumps(PARAMETERS)}
provenance: {{command: jaxnav tune, loss: 0.5, versions: {{jax: 0.10.0}}, data: [a, b]}}
"""
STUDY = """
trials: 6
axes: {corner_noise_px: [0.1, 1], selector: [lowest-reprojection, mahalanobis]}
"""
_MEASURE = {"value": 0.5, "interval": [0.4, 0.6]}
_MEASURES = (
    "success_rate",
    "wrong_branch_fraction_after_2s",
    "wrong_once_decided_fraction",
    "median_position_error_m",
    "anees",
)
SIMULATED = {
    "runs": [
        {
            "run": {"scenario": "paper", "selector": "oracle", "corner_noise_px": 1.0},
            "drives": 3,
            "time_to_decide_s": {"median": _MEASURE, "p95": {"value": None}},
        }
        | dict.fromkeys(_MEASURES, _MEASURE)
    ]
}
