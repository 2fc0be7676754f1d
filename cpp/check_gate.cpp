// Reads steps on stdin and writes decisions on stdout, for the comparison with Python. Numbers as text, so also nan and inf.
//   limits:   n  low*n high*n  brake*n coast*n ("none" for none)  max_rate*n  and the seven numbers of Limits
//   a step:   now  [action] [guided]  age silence latency observation_ok override  [human]  guided_only resume  [fallback]
//             where [x] is the number of elements, -1 for none, and the elements
#include <cstdio>
#include <iostream>
#include <string>

#include "gate.hpp"

using namespace sb3_chac;

static double number(std::istream& in) {
    std::string text;
    in >> text;
    return std::stod(text);
}

static std::optional<double> maybe(std::istream& in) {
    std::string text;
    in >> text;
    if (text == "none") return std::nullopt;
    return std::stod(text);
}

static std::optional<Action> action(std::istream& in) {
    int n;
    in >> n;
    if (n < 0) return std::nullopt;
    Action values(n);
    for (double& value : values) value = number(in);
    return values;
}

int main() {
    std::size_t n;
    std::cin >> n;
    Limits limits;
    for (Action* values : {&limits.low, &limits.high})
        for (std::size_t i = 0; i < n; i++) values->push_back(number(std::cin));
    for (auto* values : {&limits.brake, &limits.coast})
        for (std::size_t i = 0; i < n; i++) values->push_back(maybe(std::cin));
    for (std::size_t i = 0; i < n; i++) limits.max_rate.push_back(number(std::cin));
    for (double* value : {&limits.max_age, &limits.max_silence, &limits.deadline, &limits.hold_for, &limits.guided_for,
                          &limits.latch_after, &limits.tolerance})
        *value = number(std::cin);
    Gate gate(limits);
    std::string now;
    while (std::cin >> now) {
        Given given;
        given.action = action(std::cin);
        given.guided_action = action(std::cin);
        given.age = number(std::cin);
        given.silence = number(std::cin);
        given.latency = number(std::cin);
        std::cin >> given.observation_ok >> given.overridden;
        given.human_action = action(std::cin);
        std::cin >> given.guided_only >> given.resume;
        given.fallback = action(std::cin);
        const Decision decision = gate.step(std::stod(now), given);
        std::printf("%d %d %d", static_cast<int>(decision.state), decision.faults, decision.engaged);
        for (double value : decision.action) std::printf(" %.17g", value);
        std::printf("\n");
    }
}
