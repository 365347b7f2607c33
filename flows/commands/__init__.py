"""What each verb of the command line does. Modules are imported when their verb is used."""
