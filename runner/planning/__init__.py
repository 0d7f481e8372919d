"""Exact measures from an environment's transition table: policy evaluation, the optimum, best responses.

optimum = optimal_values(mdp, discount)                 the highest value of all agents together
outcome = evaluate_policy(mdp, policy, learners, 0.9)   a policy's results from every start, without sampling
best_response(mdp, policy, learner, learners, 0.9)      one agent's highest value against the others' policies
"""
