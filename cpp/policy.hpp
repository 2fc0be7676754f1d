// A policy that 'sb3-chac export' wrote, on onnxruntime's C API, behind the gate. One float observation in, a decision out.
#pragma once

#include <onnxruntime_c_api.h>

#include <array>
#include <chrono>
#include <memory>
#include <string>

#include "gate.hpp"

namespace sb3_chac {

struct Proposal {
    Action action;
    std::optional<Action> guided_action;
    std::optional<bool> self_drives;
    std::optional<double> confidence;
};

// Loads the file once; decides in one thread. Observations are a Box of float32 (no Dict, no images: use Python for those).
class Policy {
   public:
    explicit Policy(const std::string& file) {
        check(api().CreateEnv(ORT_LOGGING_LEVEL_ERROR, "sb3_chac", &env_));
        OrtSessionOptions* options = nullptr;
        check(api().CreateSessionOptions(&options));
        check(api().SetIntraOpNumThreads(options, 1));
        check(api().SetInterOpNumThreads(options, 1));
        OrtStatus* status = api().CreateSession(env_, file.c_str(), options, &session_);
        api().ReleaseSessionOptions(options);
        check(status);
        check(api().CreateCpuMemoryInfo(OrtArenaAllocator, OrtMemTypeDefault, &memory_));
        check(api().SessionGetOutputCount(session_, &n_outputs_));
        if (n_outputs_ != 1 && n_outputs_ != NAMES.size()) throw std::runtime_error(file + " was not written by sb3-chac export");
        observation_dim_ = last_dimension(true);
        action_dim_ = last_dimension(false);
        (*this)(std::vector<float>(observation_dim_));  // the first decision takes longer
    }
    Policy(const Policy&) = delete;
    Policy& operator=(const Policy&) = delete;
    ~Policy() {
        if (memory_) api().ReleaseMemoryInfo(memory_);
        if (session_) api().ReleaseSession(session_);
        if (env_) api().ReleaseEnv(env_);
    }

    std::size_t observation_dim() const { return observation_dim_; }
    std::size_t action_dim() const { return action_dim_; }

    // Throws std::invalid_argument for another size; what is not finite is for the caller to check (see Runtime)
    Proposal operator()(const std::vector<float>& observation) {
        if (observation.size() != observation_dim_) throw std::invalid_argument("the observation has another size");
        const std::array<std::int64_t, 2> shape{1, static_cast<std::int64_t>(observation_dim_)};
        OrtValue* input = nullptr;
        check(api().CreateTensorWithDataAsOrtValue(memory_, const_cast<float*>(observation.data()),
                                                   observation.size() * sizeof(float), shape.data(), shape.size(),
                                                   ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT, &input));
        const char* input_name = "observation";
        std::array<OrtValue*, 4> outputs{};
        OrtStatus* status = api().Run(session_, nullptr, &input_name, &input, 1, NAMES.data(), n_outputs_, outputs.data());
        api().ReleaseValue(input);
        std::array<Value, 4> owners;
        for (std::size_t i = 0; i < n_outputs_; i++) owners[i].reset(outputs[i]);
        check(status);
        Proposal proposal{numbers(outputs[0]), {}, {}, {}};
        if (n_outputs_ > 1) {
            proposal.guided_action = numbers(outputs[1]);
            proposal.self_drives = *data<bool>(outputs[2]);
            proposal.confidence = *data<float>(outputs[3]);
        }
        return proposal;
    }

   private:
    struct Release {
        void operator()(OrtValue* value) const { api().ReleaseValue(value); }
    };
    using Value = std::unique_ptr<OrtValue, Release>;
    static constexpr std::array<const char*, 4> NAMES{"action", "guided_action", "self_drives", "confidence"};

    static const OrtApi& api() {
        static const OrtApi* found = OrtGetApiBase()->GetApi(ORT_API_VERSION);
        if (!found) throw std::runtime_error("onnxruntime's library is older than its headers");
        return *found;
    }

    static void check(OrtStatus* status) {
        if (!status) return;
        const std::string message = api().GetErrorMessage(status);
        api().ReleaseStatus(status);
        throw std::runtime_error(message);
    }

    std::size_t last_dimension(bool of_input) const {
        OrtTypeInfo* type = nullptr;
        check(of_input ? api().SessionGetInputTypeInfo(session_, 0, &type) : api().SessionGetOutputTypeInfo(session_, 0, &type));
        const OrtTensorTypeAndShapeInfo* shape = nullptr;
        std::size_t n = 0;
        check(api().CastTypeInfoToTensorInfo(type, &shape));
        check(api().GetDimensionsCount(shape, &n));
        std::vector<std::int64_t> dimensions(n);
        check(api().GetDimensions(shape, dimensions.data(), n));
        api().ReleaseTypeInfo(type);
        if (n != 2 || dimensions[1] < 1) throw std::runtime_error("the policy's observations or actions are not vectors");
        return static_cast<std::size_t>(dimensions[1]);
    }

    template <typename T>
    static const T* data(OrtValue* value) {
        void* found = nullptr;
        check(api().GetTensorMutableData(value, &found));
        return static_cast<const T*>(found);
    }

    Action numbers(OrtValue* value) const {
        const float* first = data<float>(value);
        return Action(first, first + action_dim_);
    }

    OrtEnv* env_ = nullptr;
    OrtSession* session_ = nullptr;
    OrtMemoryInfo* memory_ = nullptr;
    std::size_t n_outputs_ = 0, observation_dim_ = 0, action_dim_ = 0;
};

// Policy and gate, once per period, as sb3_chac.deploy.runtime.Runtime. Observations within [low, high] (all elements alike).
class Runtime {
   public:
    Runtime(const std::string& file, Limits limits, float low = -1.0f, float high = 1.0f)
        : policy_(file), gate_(std::move(limits)), low_(low), high_(high) {
        if (gate_.limits().low.size() != policy_.action_dim()) throw std::invalid_argument("limits have another size");
    }

    // observation: nullptr if none has arrived since the last decision; age: [s] of it; given: who drives, and what else is known
    Decision decide(double now, const std::vector<float>* observation, double age, Given given) {
        if (observation) {
            heard_ = now;
            observed_ = now - age;
            const float slack = 1e-3f * (high_ - low_);
            valid_ = observation->size() == policy_.observation_dim() &&
                     std::all_of(observation->begin(), observation->end(),
                                 [&](float value) { return low_ - slack <= value && value <= high_ + slack; });
            if (valid_) {
                const auto start = std::chrono::steady_clock::now();
                proposal_ = policy_(*observation);
                latency_ = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
            }
        }
        if (proposal_) {
            given.action = proposal_->action;
            given.guided_action = proposal_->guided_action;
        }
        given.age = now - observed_;
        given.silence = now - heard_;
        given.latency = latency_;
        given.observation_ok = valid_;
        return gate_.step(now, given);
    }

    const std::optional<Proposal>& proposal() const { return proposal_; }
    Policy& policy() { return policy_; }

   private:
    Policy policy_;
    Gate gate_;
    float low_, high_;
    bool valid_ = false;
    double heard_ = -std::numeric_limits<double>::infinity(), observed_ = heard_, latency_ = 0;
    std::optional<Proposal> proposal_;
};

}  // namespace sb3_chac
