// Reads observations (numbers as text) on stdin and writes what the policy proposes, for the comparison with Python.
#include <cstdio>
#include <iostream>

#include "policy.hpp"

int main(int argc, char** argv) {
    if (argc != 2) {
        std::fprintf(stderr, "usage: check_policy POLICY.onnx < observations\n");
        return 2;
    }
    try {
        sb3_chac::Policy policy(argv[1]);
        std::vector<float> observation(policy.observation_dim());
        while (true) {
            for (float& value : observation)
                if (!(std::cin >> value)) return 0;
            const sb3_chac::Proposal proposal = policy(observation);
            for (double value : proposal.action) std::printf("%.9g ", value);
            if (proposal.guided_action)
                for (double value : *proposal.guided_action) std::printf("%.9g ", value);
            if (proposal.confidence) std::printf("%d %.9g", *proposal.self_drives, *proposal.confidence);
            std::printf("\n");
        }
    } catch (const std::exception& error) {
        std::fprintf(stderr, "check_policy: %s\n", error.what());
        return 1;
    }
}
