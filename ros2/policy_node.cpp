// A ROS 2 node around sb3_chac::Runtime: ~/observation (Float32MultiArray) in, ~/action (Float32MultiArray: the action, then the
// state and the faults) out, ~/override (Bool) and ~/resume (Empty) from the person. cpp/CMakeLists.txt builds it where rclcpp is.
#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/bool.hpp>
#include <std_msgs/msg/empty.hpp>
#include <std_msgs/msg/float32_multi_array.hpp>

#include "policy.hpp"

using std_msgs::msg::Bool, std_msgs::msg::Empty, std_msgs::msg::Float32MultiArray;

class PolicyNode : public rclcpp::Node {
   public:
    PolicyNode() : Node("sb3_chac_policy") {
        const auto file = declare_parameter<std::string>("policy");
        const auto rate = declare_parameter<double>("rate", 10.0);
        sb3_chac::Limits limits;
        limits.low = declare_parameter<std::vector<double>>("low", {-1.0, -1.0});
        limits.high = declare_parameter<std::vector<double>>("high", {1.0, 1.0});
        limits.max_rate = declare_parameter<std::vector<double>>("max_rate", {20.0, 20.0});
        // Of SafeDrive-v0 and RoadTest-v0: steering is held, the brake is the least acceleration
        limits.brake = {std::nullopt, limits.low.back()};
        limits.coast = {std::nullopt, 0.0};
        limits.max_silence = declare_parameter<double>("max_silence", 0.25);
        limits.hold_for = declare_parameter<double>("hold_for", 0.2);
        limits.deadline = declare_parameter<double>("deadline", 0.05);
        runtime_ = std::make_unique<sb3_chac::Runtime>(file, limits);
        actions_ = create_publisher<Float32MultiArray>("~/action", 1);
        const auto newest = rclcpp::QoS(1).best_effort();
        observations_ = create_subscription<Float32MultiArray>(
            "~/observation", newest, [this](Float32MultiArray::ConstSharedPtr message) { decide(&message->data); });
        overrides_ = create_subscription<Bool>("~/override", 1, [this](Bool::ConstSharedPtr message) {
            given_.overridden = message->data;
            decide(nullptr);  // at once
        });
        resumes_ = create_subscription<Empty>("~/resume", 1, [this](Empty::ConstSharedPtr) {
            given_.resume = true;
            decide(nullptr);
            given_.resume = false;
        });
        timer_ = create_wall_timer(std::chrono::duration<double>(1.0 / rate), [this] { decide(nullptr); });
    }

   private:
    void decide(const std::vector<float>* observation) {
        const double now = std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
        const auto decision = runtime_->decide(now, observation, 0.0, given_);
        if (!decision.engaged) return;  // the person drives by the vehicle's own means
        Float32MultiArray message;
        message.data.assign(decision.action.begin(), decision.action.end());
        message.data.push_back(static_cast<float>(decision.state));
        message.data.push_back(static_cast<float>(decision.faults));
        actions_->publish(message);
    }

    std::unique_ptr<sb3_chac::Runtime> runtime_;
    sb3_chac::Given given_;
    rclcpp::Publisher<Float32MultiArray>::SharedPtr actions_;
    rclcpp::Subscription<Float32MultiArray>::SharedPtr observations_;
    rclcpp::Subscription<Bool>::SharedPtr overrides_;
    rclcpp::Subscription<Empty>::SharedPtr resumes_;
    rclcpp::TimerBase::SharedPtr timer_;
};

int main(int argc, char** argv) {
    rclcpp::init(argc, argv);
    rclcpp::spin(std::make_shared<PolicyNode>());
    rclcpp::shutdown();
}
