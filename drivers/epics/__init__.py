"""EPICS: process variables by PVAccess and Channel Access, and the devices behind them that are no stages."""
