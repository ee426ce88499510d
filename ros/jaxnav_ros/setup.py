"""Install the node, its launch file and its parameters where ROS 2 looks for them."""

from setuptools import setup

NAME = "jaxnav_ros"

setup(
    name=NAME,
    version="0.1.0",
    description="jaxnav as a lifecycle node of ROS 2",
    license="Apache-2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/jaxnav.launch.py"]),
        (f"share/{NAME}/config", ["config/jaxnav.yaml"]),
    ],
    entry_points={"console_scripts": [f"node = {NAME}.node:main"]},
    zip_safe=True,
)
