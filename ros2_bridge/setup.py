"""The ROS 2 package `bridge` for colcon; for pip, use the pyproject.toml above.

What goes to share/bridge is what lies in these folders; the pyproject.toml names the same ones.
"""

from pathlib import Path

from setuptools import find_packages, setup

SHARED_FOLDERS = ("launch", "config", "urdf")


def data_files():
    yield "share/ament_index/resource_index/packages", ["resource/bridge"]
    yield "share/bridge", ["package.xml"]
    for folder in SHARED_FOLDERS:
        files = sorted(str(file) for file in Path(folder).iterdir() if file.is_file())
        yield f"share/bridge/{folder}", files


setup(
    name="bridge",
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed"]},
    data_files=list(data_files()),
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    python_requires=">=3.11",
    maintainer="The ethercat-server authors",
    maintainer_email="maintainers@example.org",
    description="Publishes the force/torque sensor that ethercat-server serves: every sample, fresh, once.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["client = bridge.client:main"]},
)
