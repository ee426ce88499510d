"""Start jaxnav's node; unless told otherwise, configure and activate it at once.

ros2 launch jaxnav_ros jaxnav.launch.py parameters:=my_car.yaml activate:=false
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.conditions import IfCondition
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch_ros.substitutions import FindPackageShare
from lifecycle_msgs.msg import Transition


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` runs."""
    own = PathJoinSubstitution([FindPackageShare("jaxnav_ros"), "config", "jaxnav.yaml"])
    node = LifecycleNode(
        package="jaxnav_ros",
        executable="node",
        name="jaxnav",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("parameters")],
        output="screen",
    )

    def change(transition: int) -> EmitEvent:
        event = ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=transition)
        return EmitEvent(event=event, condition=IfCondition(LaunchConfiguration("activate")))

    # Only from `configuring`: whoever deactivates the node wants it to stay so.
    when_configured = OnStateTransition(
        target_lifecycle_node=node,
        start_state="configuring",
        goal_state="inactive",
        entities=[change(Transition.TRANSITION_ACTIVATE)],
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "parameters", default_value=own, description="file of the node's parameters"
            ),
            DeclareLaunchArgument(
                "activate", default_value="true", description="configure and activate at once?"
            ),
            DeclareLaunchArgument(
                "namespace", default_value="", description="what the node's topics begin with"
            ),
            RegisterEventHandler(when_configured),
            node,
            change(Transition.TRANSITION_CONFIGURE),
        ]
    )
