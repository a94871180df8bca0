"""The ROS 2 package `bridge` for colcon; for pip, use the pyproject.toml above."""

from setuptools import setup

setup(
    name="bridge",
    version="0.1.0",
    packages=["bridge", "protocol"],
    package_data={"": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/bridge"]),
        ("share/bridge", ["package.xml"]),
        ("share/bridge/launch", ["launch/bridge.launch.py"]),
        ("share/bridge/config", ["config/bridge.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    python_requires=">=3.11",
    maintainer="The ethercat-server authors",
    maintainer_email="maintainers@example.org",
    description="Publishes the force/torque sensor that ethercat-server serves: every sample, fresh, once.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["client = bridge.client:main"]},
)
