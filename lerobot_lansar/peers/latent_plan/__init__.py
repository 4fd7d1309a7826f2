"""What MCIL and HULC share: policies that draw a latent plan and act on it.

configuration  LatentPlanConfig: every option; two sets of its values are MCIL and HULC
modeling       LatentPlanPolicy: the loss in training; plans and actions at inference
network        encoders, plans and decoder, tensors in and out
mixture        discretised logistic mixtures
hand_frame     relative actions in the frame of the hand
"""
