"""Ready problems and the reproduction of the paper's experiment (imported on demand)."""

from perfcontrol._calls import explain_calls
from perfcontrol.experiments.prices.market import market
from perfcontrol.experiments.prices.table import PriceTable, read_prices
from perfcontrol.experiments.stock import stock_market, stock_sensitivities

__all__ = ["PriceTable", "market", "read_prices", "stock_market", "stock_sensitivities"]

explain_calls(__name__, globals(), __all__)
