// The gate between a policy and a vehicle: the same as sb3_chac/deploy/gate.py, which documents it. Header only, C++17, no
// dependencies, no allocation beyond that of the vectors it is given. tests/test_deploy_cpp.py compares the two step by step.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <stdexcept>
#include <utility>
#include <vector>

namespace sb3_chac {

using Action = std::vector<double>;

enum class State : std::uint8_t { NOMINAL, GUIDED, HOLD, BRAKE, HUMAN };

enum Fault : std::uint16_t { NONE = 0, OBSERVATION = 1, AGE = 2, SILENCE = 4, DEADLINE = 8, ACTION = 16, CLOCK = 32, LATCHED = 64 };

// What the gate is given at one step; times in seconds
struct Given {
    std::optional<Action> action, guided_action;
    double age = 0, silence = 0, latency = 0;
    bool observation_ok = true, overridden = false;
    std::optional<Action> human_action;
    bool guided_only = false, resume = false;
    std::optional<Action> fallback;
};

struct Decision {
    Action action;
    State state;
    std::uint16_t faults;
    bool engaged;
};

struct Limits {
    Action low, high;
    std::vector<std::optional<double>> brake, coast;
    Action max_rate;
    double max_age = 0.35, max_silence = 0.09, deadline = 0.05, hold_for = 0.1, guided_for = 1.0, latch_after = 1.0;
    double tolerance = 1e-3;

    void check() const {
        const auto n = low.size();
        bool good = n > 0 && high.size() == n && brake.size() == n && coast.size() == n && max_rate.size() == n;
        for (std::size_t i = 0; good && i < n; i++) {
            good = std::isfinite(low[i]) && std::isfinite(high[i]) && low[i] < high[i] && std::isfinite(max_rate[i]) &&
                   max_rate[i] > 0 && within(brake[i], i) && within(coast[i], i);
        }
        for (double value : {max_age, max_silence, deadline, hold_for, guided_for, latch_after, tolerance})
            good = good && std::isfinite(value) && value >= 0;
        if (!good) throw std::invalid_argument("sb3_chac::Limits: sizes differ, or a value is not finite or out of its range");
    }

   private:
    bool within(const std::optional<double>& value, std::size_t i) const {
        return !value || (low[i] <= *value && *value <= high[i]);
    }
};

class Gate {
   public:
    explicit Gate(Limits limits) : limits_(std::move(limits)) {
        limits_.check();
        reset();
    }

    void reset() {
        state_ = State::BRAKE;
        action_.resize(limits_.low.size());
        for (std::size_t i = 0; i < action_.size(); i++)
            action_[i] = limits_.brake[i] ? *limits_.brake[i] : std::clamp(0.0, limits_.low[i], limits_.high[i]);
        now_ = valid_at_ = guided_until_ = -INF;
        brakes_since_ = INF;
        latched_ = false;
    }

    State state() const { return state_; }
    const Action& action() const { return action_; }
    const Limits& limits() const { return limits_; }

    Decision step(double now, const Given& given) {
        double dt = now_ > -INF ? now - now_ : 0.0;
        std::uint16_t faults = NONE;
        if (std::isfinite(now) && now > now_) {
            now_ = now;
        } else {
            dt = 0.0;
            faults = CLOCK;
        }
        faults |= compared(given);
        latched_ = latched_ && !(given.resume || given.overridden);
        if (latched_) faults |= LATCHED;

        const auto wanted = valid(given.action);
        const auto guided = given.guided_action ? valid(given.guided_action) : wanted;
        const bool is_nominal = wanted && !given.guided_only && now_ >= guided_until_;
        const auto& chosen = is_nominal ? wanted : guided;
        if (!wanted || !chosen) faults |= ACTION;

        State state;
        if (given.overridden)
            state = State::HUMAN;
        else if (chosen && (faults == NONE || faults == ACTION))
            state = is_nominal ? State::NOMINAL : State::GUIDED;
        else if (!(faults & CLOCK) && state_ != State::BRAKE && now_ - valid_at_ <= limits_.hold_for)
            state = State::HOLD;
        else
            state = State::BRAKE;
        remember(state);
        return leave(chosen, given, dt, faults);
    }

   private:
    static constexpr double INF = std::numeric_limits<double>::infinity();

    std::uint16_t compared(const Given& given) const {
        std::uint16_t faults = given.observation_ok ? NONE : OBSERVATION;  // NaN fails every comparison
        if (!(0 <= given.age && given.age <= limits_.max_age)) faults |= AGE;
        if (!(0 <= given.silence && given.silence <= limits_.max_silence)) faults |= SILENCE;
        if (!(0 <= given.latency && given.latency <= limits_.deadline)) faults |= DEADLINE;
        return faults;
    }

    std::optional<Action> valid(const std::optional<Action>& action) const {
        if (!action || action->size() != limits_.low.size()) return std::nullopt;
        Action values(*action);
        for (std::size_t i = 0; i < values.size(); i++) {
            const double low = limits_.low[i], high = limits_.high[i], slack = limits_.tolerance * (high - low);
            if (!(low - slack <= values[i] && values[i] <= high + slack)) return std::nullopt;
            values[i] = std::min(std::max(values[i], low), high);
        }
        return values;
    }

    void remember(State state) {
        if (state == State::NOMINAL || state == State::GUIDED) valid_at_ = now_;
        if (state == State::BRAKE || state == State::HUMAN) guided_until_ = now_ + limits_.guided_for;
        if (state != State::BRAKE)
            brakes_since_ = INF;
        else if (state_ != State::BRAKE)
            brakes_since_ = now_;
        else if (now_ - brakes_since_ > limits_.latch_after)
            latched_ = true;
        state_ = state;
    }

    Decision leave(const std::optional<Action>& chosen, const Given& given, double dt, std::uint16_t faults) {
        const auto human = valid(given.human_action), fallback = valid(given.fallback);
        bool engaged = true;
        if ((state_ == State::NOMINAL || state_ == State::GUIDED) && chosen) {
            towards(*chosen, dt);
        } else if (state_ == State::HUMAN && !given.human_action) {
            engaged = false;
            coast();
        } else if (state_ == State::HUMAN && human) {
            action_ = *human;
        } else if (state_ == State::HOLD) {
            coast();
        } else {
            if (state_ == State::HUMAN) faults |= ACTION;
            if (fallback) towards(*fallback, dt);
            for (std::size_t i = 0; i < action_.size(); i++)
                if (limits_.brake[i]) action_[i] = *limits_.brake[i];
        }
        return {action_, state_, faults, engaged};
    }

    void towards(const Action& action, double dt) {
        for (std::size_t i = 0; i < action_.size(); i++) {
            const double step = limits_.max_rate[i] * dt;
            action_[i] = std::min(std::max(action[i], action_[i] - step), action_[i] + step);
        }
    }

    void coast() {
        for (std::size_t i = 0; i < action_.size(); i++)
            if (limits_.coast[i]) action_[i] = std::min(action_[i], *limits_.coast[i]);
    }

    Limits limits_;
    State state_;
    Action action_;
    double now_, valid_at_, guided_until_, brakes_since_;
    bool latched_;
};

}  // namespace sb3_chac
