# The nodes on ROS 2 Jazzy and Ubuntu 24.04, as doc/ros.md installs them. Our tests do not build it.
#   docker build -t hexapod_comp . && docker run --rm --net=host hexapod_comp
FROM ros:jazzy
WORKDIR /ws
COPY . src/hexapod_comp
RUN apt-get update \
    && rosdep update \
    && rosdep install -y --from-paths src --ignore-src --dependency-types build --dependency-types exec \
    && apt-get install -y --no-install-recommends ros-jazzy-robot-state-publisher \
    && rm -rf /var/lib/apt/lists/*
RUN . /opt/ros/jazzy/setup.sh \
    && colcon build --packages-select hexapod_comp
STOPSIGNAL SIGINT
CMD ["bash", "-c", ". install/setup.bash && exec ros2 launch hexapod_comp machine.launch.py model:=paper_machine.yaml"]
