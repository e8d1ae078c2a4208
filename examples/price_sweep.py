"""How much may an action cost until routing to the large policy stops paying? A sweep over alpha_price."""

import osel_sim as osel

for alpha_price in (0.0, 0.005, 0.01, 0.02, 0.04):
    out = f"runs/price_sweep/{alpha_price}"
    found = osel.replay("assets/logs/pick_place", selectors="auto", alpha_price=alpha_price, seeds=3, no_frontier=True, out=out, overwrite=True)
    auto = found.selectors.set_index("selector").loc["auto"]
    print(f"alpha_price {alpha_price:5}: reward {auto['mean_reward']:.3f}, success {auto['success_rate']:.0%}, {auto['mean_price']:.2f} cents")
