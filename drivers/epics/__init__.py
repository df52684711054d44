"""EPICS: process variables over PVAccess and Channel Access, and the devices behind them except stages."""
