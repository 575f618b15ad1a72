"""Write a drive as EuRoC and TUM RGB-D have theirs."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

T_BS = np.array(  # of EuRoC's left camera
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
SENSOR = """sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: {body}
rate_hz: 20
resolution: {size}
camera_model: pinhole
intrinsics: {camera} #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: {distortion}
"""


def write_images(folder, names, images):
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in zip(names, images, strict=True):
        cv2.imwrite(str(folder / name), image)


def write_euroc(folder, images, intrinsics, stamps, distortion=(0.0, 0.0, 0.0, 0.0)):
    """Frames with their times in nanoseconds, and the camera."""
    names = [f"{stamp}.png" for stamp in stamps]
    camera = folder / "mav0/cam0"
    write_images(camera / "data", names, images)
    lines = "".join(f"{stamp},{name}\r\n" for stamp, name in zip(stamps, names))
    (camera / "data.csv").write_text(f"#timestamp [ns],filename\r\n{lines}")
    height, width = images[0].shape
    (fx, _, cx), (_, fy, cy), _ = intrinsics.tolist()
    text = SENSOR.format(
        body=T_BS.ravel().tolist(),
        size=[width, height],
        camera=[fx, fy, cx, cy],
        distortion=list(distortion),
    )
    (camera / "sensor.yaml").write_text(text)


def write_euroc_truth(path, poses, stamps, digits=15):
    """Poses of a body, (n, 4, 4), at times in nanoseconds; quaternions have w first."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    rows = np.column_stack([poses[:, :3, 3], quaternions, np.zeros((len(poses), 9))])
    lines = ["#timestamp, p_RS_R_x [m], ..."]
    for stamp, row in zip(stamps, rows.tolist(), strict=True):
        numbers = [f"{number:.{digits}f}" for number in row]
        lines.append(",".join([str(int(stamp)), *numbers]))
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join([*lines, ""]))


def write_tum_frames(folder, images, seconds):
    names = [f"{second:.6f}.png" for second in seconds]
    write_images(folder / "rgb", names, images)
    lines = "".join(f"{name[:-4]} rgb/{name}\n" for name in names)
    (folder / "rgb.txt").write_text(f"# color images\n# file: 'x.bag'\n{lines}")
